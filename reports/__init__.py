"""What is concluded: tables, charts and pages from the documented tables.

Pure functions that import no other package of this project.
"""
