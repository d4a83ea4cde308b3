"""Navigation: trajectories from GNSS, IMU and odometer, and the clocks of sensors."""
