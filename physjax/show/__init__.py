"""What you look at: plots, films, pages to turn in 3-D, and exports of a run."""
