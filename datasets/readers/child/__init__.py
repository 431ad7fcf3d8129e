"""The process that reads one file for :mod:`.datasets.readers.sandbox`: a module per library.

Requests come as lines of JSON on stdin. Each answer is a line of JSON on stdout, followed by the raw values
of the arrays that it announces.
"""
