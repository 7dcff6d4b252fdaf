"""What the grains are worth: exact cases, experiments, and laws that every right answer obeys."""
