//! Serial framing, NMEA, Garmin sentences, compass formats.
