"""The plugins: one interface, one registry, one module per method.

Importing this package imports no method; specs are import-light and name the module to load.
"""
