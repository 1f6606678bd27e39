"""Figures as data, drawn for papers and for the report."""
