"""The paper's tables and claims beside what was measured."""
