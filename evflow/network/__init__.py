"""The network: events <-> camera parameters, given the change of intensity (api.py)."""
