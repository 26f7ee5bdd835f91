"""The systemd unit, as package data."""
