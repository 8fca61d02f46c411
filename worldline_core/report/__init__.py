"""The report: one static page with tables, plots, pictures and videos; inspection of artifacts; nightly comparison."""
