"""The harness: suites, jobs, stores, tables, the gate and the command line."""
