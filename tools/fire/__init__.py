"""Attacks on the harness: each module is one kind, counts what held, and ends with 1 on any deviation."""
