"""The DQN learner, its replay buffer and its experience."""
