"""The training loops of evolution and of the DQN."""
