"""What every page that this project writes is made with: templates, tables, charts, styles. Nothing comes from a network."""
