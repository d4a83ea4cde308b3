"""What stands upright beside the road and hangs over it: shafts, plates, upright planes, and their shared figures."""
