"""The data: volumes, transfer functions, cameras, scenes and ground-truth views.

This package imports none of the other four. Its heavy parts (Mitsuba, torch, file-format
libraries) are imported by the functions that need them, so that listing the catalogue is cheap.
"""
