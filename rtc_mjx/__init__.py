"""rtc_mjx: Robust Type Conditioning and its baselines, on worlds stepped and differentiated by MuJoCo MJX."""

__version__ = "0.1.0"
