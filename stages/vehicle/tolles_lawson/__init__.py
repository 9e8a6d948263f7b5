"""Tolles-Lawson compensation: taking an aircraft off what its scalar magnetometer measures."""
