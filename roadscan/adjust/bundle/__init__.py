"""Pictures in the adjustment: what cameras saw, as observations of poses, mountings and lenses."""
