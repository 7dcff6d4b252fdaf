"""What contact between grains and bodies is worth: scenes with known answers, measured, and shared with tests."""
