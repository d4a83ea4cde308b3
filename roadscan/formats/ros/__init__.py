"""Reads recordings of ROS 1 and ROS 2 (bags): the containers, and a raw format for each kind of topic."""
