"""Driving a policy on C MuJoCo: scripts, films, traces, the page in the browser."""
