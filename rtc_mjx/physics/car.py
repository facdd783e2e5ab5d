"""Facts of assets/car.xml that other code needs as numbers."""

WHEELBASE = 2.8  # m
CONTROL_UNIT = (1.5, 0.08)  # m/s^2 and rad: a typical size of drive and steer
