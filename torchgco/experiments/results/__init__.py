"""The rows of a study on the disk: identity, provenance, merging."""
