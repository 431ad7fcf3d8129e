"""The gate: results against a baseline, with tolerances from the spread of repetitions."""
