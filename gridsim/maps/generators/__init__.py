"""The generated roads: each file of this folder is a scenario of the same name, described by its `SCENARIO`."""
