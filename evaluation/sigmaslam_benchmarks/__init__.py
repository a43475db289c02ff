"""What measures the product: pages, peers and trials, run from a checkout."""
