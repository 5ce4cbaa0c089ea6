"""Methods that KiRAS is compared with, each a part of the same learner in one file."""
