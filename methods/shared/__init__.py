"""What the built-in methods share: base classes of methods, models and trainers, and files of models."""
