"""What you look at: plots and reports."""
