"""Maps: roads, lanes, clearance fields, the scenarios that generate them, and maps from files."""
