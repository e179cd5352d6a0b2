"""What each command does: mimic/NAME.py starts mimic/commands/NAME.py."""
