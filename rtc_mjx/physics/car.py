"""Facts of assets/car.xml that other code needs as numbers."""

CAR = (4.6, 1.9)  # m, length and width
WHEELBASE = 2.8  # m
CONTROL_UNIT = (1.5, 0.08)  # m/s^2 and rad: a typical size of drive and steer
