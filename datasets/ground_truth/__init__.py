"""Renderers of ground truth: one optical model, a fast Dr.Jit marcher and a torch oracle."""
