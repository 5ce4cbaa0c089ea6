"""Learning algorithms: PPO with two critics, its losses, returns and storage."""
