"""What you look at: plots, films and reports."""
