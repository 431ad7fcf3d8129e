"""Methods that other programs carry out, declared by a TOML file: see ``docs/guide/command-plugins.md``."""

from econgs_bench.methods.command.file import command_spec as command_spec
