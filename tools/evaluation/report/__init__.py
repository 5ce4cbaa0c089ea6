"""Results as tables and figures, and the files and pages made of them."""
