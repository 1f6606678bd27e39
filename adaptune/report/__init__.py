"""What results look like: tables, charts and the page."""
