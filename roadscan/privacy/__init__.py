"""Privacy: what shows people and vehicles in pictures is found and made unrecognisable before they are published."""
