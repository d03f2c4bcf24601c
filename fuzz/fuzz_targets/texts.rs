//! Any bytes as a serial log with times and as tables of samples: no panic, times in order, figures that are numbers.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover::io::import::{read_attitude, read_inertial, read_serial_log};

/// Headers of the tables; the fuzzer writes the rows.
const INERTIAL: &[u8] = b"time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,acc_x_mps2,acc_y_mps2,acc_z_mps2\n";
const ATTITUDE: &[u8] = b"time_s,heading_deg,pitch_deg,roll_deg\n";

fuzz_target!(|data: &[u8]| {
    windhover_fuzz::with_file("log", &[data], |path| {
        let Ok(log) = read_serial_log(path) else { return };
        assert!(log.lines.is_sorted_by_key(|(t, _)| *t));
        let bytes: usize = log.lines.iter().map(|(_, line)| line.len()).sum();
        assert!(bytes <= 2 * data.len() + 2);
    });
    windhover_fuzz::with_file("csv", &[INERTIAL, data], |path| {
        let Ok(table) = read_inertial(path) else { return };
        let mut figures =
            table.samples.iter().flat_map(|(_, sample)| [sample.rate_rps, sample.force_mps2]).flatten();
        assert!(figures.all(|figures| figures.iter().all(|figure| figure.is_finite())));
    });
    windhover_fuzz::with_file("csv", &[ATTITUDE, data], |path| {
        let Ok(table) = read_attitude(path) else { return };
        assert!(table.samples.iter().all(|(_, sample)| sample.heading.is_none_or(f64::is_finite)));
    });
});
