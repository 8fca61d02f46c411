"""Corrupted recordings at known labels, in the layouts of several sources: what the accounting of curation is held against."""
