"""Before anything is measured: which parameters matter, and which stations will show them."""
