"""Calibration of vector magnetometers: bias, scale factors and distortion from motion."""
