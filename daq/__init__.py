"""Acquisition, entrainment, campaigns, run store, service and command line."""
