"""KiRAS-RL on a robot: kiras_rl.deploy alone."""
