"""Logs of surveys and vehicles, read into track/1: one row for each magnetometer sample.

What ``ingest-log`` hands on, and later stages may rely on:

- `time` is UTC and ascends. Rows recorded after a clock went back, or twice, are sorted in and
  carry ``TrackFlag.CLOCK_STEP`` (of tables the fewest rows that break the order of a line); without
  them time strictly ascends.
- `field_body` (time, axis) is nT in the body frame forward, right, down once the source's
  `sensor_to_body` is applied, else in the sensor's axes as written; `field_total` is nT.
  ``FIELD_GAP`` marks rows without a field.
- `attitude` (time, quaternion) is w, x, y, z and turns vectors of the body frame into north, east,
  down; NaN where unknown.
- `latitude`, `longitude`, `height` are the sensor's: interpolated between the two valid fixes
  around each row no more than `max_gap_s` (attribute) apart, and moved from the antenna by
  `lever_arm_m` (attribute: antenna to magnetometer, forward, right, down). Elsewhere they are NaN
  and flagged: ``POSITION_GAP`` between two valid fixes, ``NO_FIX`` before the first and after the
  last, or where a receiver without a fix lies between.
- The fixes themselves stay on dimension `fix`, so that positions can be made anew
  (`magtiles.stages.vehicle.positions`): `fix_time` (strictly ascending), `fix_latitude`,
  `fix_longitude`, `fix_height`, `fix_status` (-1 no fix, 0 fix, 1 satellite-based, 2 ground-based
  augmentation) and 1 sigma `fix_horizontal_sigma`, `fix_vertical_sigma` in m, NaN if unknown.
  They are the antenna's.
- Attitude samples stay on dimension `attitude_sample`: `attitude_time`, `attitude_quaternion`,
  and `angular_rate` (attitude_sample, axis) in rad/s about the body axes, NaN if unknown.
- Formats whose rows carry their own position (survey lines) have neither dimension. The survey's
  own columns that the source names are kept as ``source_<name>``, in the units it states.
- `sensor_to_body` (attribute, nine numbers by rows) is there once it was applied.
"""
