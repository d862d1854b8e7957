"""Frames of running trains become trips of the history; alarms are sent to people."""
