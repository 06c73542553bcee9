"""Where members are evaluated: tasks, workers, pools and the dispatch of chunks."""
