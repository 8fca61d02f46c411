"""The sections of the report: each makes one part of the page from whatever artifacts there are."""
