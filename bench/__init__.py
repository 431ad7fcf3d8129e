"""The experiment: suites, plan, jobs, run store, measuring, command line."""
