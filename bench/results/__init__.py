"""From records to tables: lineage, versions, comparison, bundles."""
