"""The files that ``bench new-method --command`` writes: a program that imports nothing of this project."""
