"""What runs a policy on a robot: driver, runtime and operator, three processes."""
