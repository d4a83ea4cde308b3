"""Cracks and other narrow valleys of a surface."""
