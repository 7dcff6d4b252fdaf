"""What bodies do in grains, held against experiments and limit theorems: suites that measure physics, not time."""
