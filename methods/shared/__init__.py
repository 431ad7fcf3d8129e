"""Shared parts of the methods: base classes of methods, models and trainers, and files of models."""
