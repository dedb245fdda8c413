"""Netlist and events to spikes, verdicts and costs; holds the command line."""
