"""The run store: folders of jobs, records, leases, progress."""
