"""Files of assets: classified points, bare earth, layers for GIS and drawings for CAD."""
