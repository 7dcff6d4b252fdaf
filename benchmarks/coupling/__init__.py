"""What contact between grains and bodies is worth: scenes with known answers, measured, for docs/coupling.md and tests."""
