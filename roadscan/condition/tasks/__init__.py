"""Tasks of the road's condition: reference lines, stretches of lanes, values of indices, sections."""
