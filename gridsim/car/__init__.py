"""What drives: the kinematic bicycle, the control period and its ends, the reward."""
