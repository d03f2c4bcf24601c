//! Measurements in order of validity, whatever the order of their arrival.
