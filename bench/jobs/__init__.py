"""The kinds of jobs: a module each, run in a process of its own (see ``econgs_bench.bench.run.worker``)."""
