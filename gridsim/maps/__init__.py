"""What is driven on: roads, lanes and their network, clearance fields, and maps from files."""
