"""KiRAS-RL: keyframe-guided self-imitation of legged skills."""

__version__ = "0.1.0"
