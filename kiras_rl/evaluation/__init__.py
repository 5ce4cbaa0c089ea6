"""What is measured of a policy, by protocol: without action noise, on robots from a fixed seed."""
