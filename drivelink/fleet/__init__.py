"""Many recordings of many joints: fitted and diagnosed on Dask, kept in a table, watched for change.

Needs the extra `fleet`; nothing else of the service imports this package.
"""
