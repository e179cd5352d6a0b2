"""The commands: mimic/NAME.py starts mimic/commands/NAME.py."""
