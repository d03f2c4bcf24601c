//! A warm state as a message, exact to the bit.

use crate::io::proto::{timestamp, windhover};
use windhover_base::msg::{WARM_STATES, WarmArrival, WarmFilter, WarmSite, WarmState};
use windhover_base::time::MonoTime;

/// A warm state as a message without origin.
pub fn message(t: MonoTime, state: &WarmState) -> windhover::WarmState {
    let filter = state.filter.as_ref();
    let triangle = |f: &WarmFilter| {
        let covariance = f.covariance;
        (0..WARM_STATES).flat_map(move |i| (i..WARM_STATES).map(move |j| covariance[i][j])).collect()
    };
    windhover::WarmState {
        timestamp: Some(timestamp(t)),
        datum_lat_deg: state.site.datum[0],
        datum_lon_deg: state.site.datum[1],
        datum_height_m: state.site.datum[2],
        ground_height_m: state.site.ground_height_m,
        geoid_m: state.site.geoid_m,
        declination_rad: state.site.declination_rad,
        arrival_ns: steps(state.arrivals.iter().map(|a| a.t_ns)),
        offset_ns: steps(state.arrivals.iter().map(|a| a.offset_ns)),
        filter_ns: filter.map_or(0, |f| f.t_ns),
        filter_mean: filter.map_or(Vec::new(), |f| f.mean.to_vec()),
        filter_covariance: filter.map_or(Vec::new(), triangle),
        filter_fitted: filter.map_or(Vec::new(), |f| f.fitted.to_vec()),
        ..Default::default()
    }
}

/// The state of a message; `None` where it is not of this version of the program.
pub fn state(message: &windhover::WarmState) -> Option<WarmState> {
    if message.arrival_ns.len() != message.offset_ns.len() {
        return None;
    }
    let arrivals = sums(&message.arrival_ns).zip(sums(&message.offset_ns));
    let filter = if message.filter_mean.is_empty() { None } else { Some(filter(message)?) };
    Some(WarmState {
        site: WarmSite {
            datum: [message.datum_lat_deg, message.datum_lon_deg, message.datum_height_m],
            ground_height_m: message.ground_height_m,
            geoid_m: message.geoid_m,
            declination_rad: message.declination_rad,
        },
        arrivals: arrivals.map(|(t_ns, offset_ns)| WarmArrival { t_ns, offset_ns }).collect(),
        filter,
    })
}

fn filter(message: &windhover::WarmState) -> Option<WarmFilter> {
    let mut covariance = [[0.0; WARM_STATES]; WARM_STATES];
    let mut values = message.filter_covariance.iter();
    for i in 0..WARM_STATES {
        for j in i..WARM_STATES {
            let value = *values.next()?;
            (covariance[i][j], covariance[j][i]) = (value, value);
        }
    }
    Some(WarmFilter {
        t_ns: message.filter_ns,
        mean: message.filter_mean.as_slice().try_into().ok()?,
        covariance,
        fitted: message.filter_fitted.as_slice().try_into().ok()?,
    })
}

/// The first value, then the differences: small numbers take few bytes.
fn steps(values: impl Iterator<Item = i64>) -> Vec<i64> {
    values
        .scan(0i64, |before, value| {
            let step = value.wrapping_sub(*before);
            *before = value;
            Some(step)
        })
        .collect()
}

fn sums(steps: &[i64]) -> impl Iterator<Item = i64> + '_ {
    steps.iter().scan(0i64, |sum, step| {
        *sum = sum.wrapping_add(*step);
        Some(*sum)
    })
}

#[cfg(test)]
mod tests {
    use prost::Message as _;

    use super::*;

    fn learnt() -> WarmState {
        let mut covariance = [[0.0; WARM_STATES]; WARM_STATES];
        for i in 0..WARM_STATES {
            for j in i..WARM_STATES {
                let value = 1.0 / (1 + i * WARM_STATES + j) as f64;
                (covariance[i][j], covariance[j][i]) = (value, value);
            }
        }
        let t0 = 1_795_000_000_123_456_789;
        WarmState {
            site: WarmSite {
                datum: [38.7, -9.2, 83.1],
                ground_height_m: 83.0,
                geoid_m: 50.1,
                declination_rad: -0.06,
            },
            arrivals: (0..50)
                .map(|k| WarmArrival { t_ns: t0 + k * 200_017_003, offset_ns: t0 - 5_000 + k * 17_003 })
                .collect(),
            filter: Some(WarmFilter {
                t_ns: t0,
                mean: std::array::from_fn(|i| 0.1 * i as f64),
                covariance,
                fitted: [0.3; 6],
            }),
        }
    }

    #[test]
    fn a_state_comes_back_to_the_last_bit_and_is_small() {
        let state_before = learnt();
        let bytes = message(MonoTime::from_ns(7), &state_before).encode_to_vec();
        let read = windhover::WarmState::decode(&bytes[..]).expect("decodes");
        assert_eq!(state(&read), Some(state_before));
        assert!(bytes.len() < 1024, "{} bytes: last known states are stored in the index", bytes.len());
        let nothing = WarmState { arrivals: Vec::new(), filter: None, ..learnt() };
        assert_eq!(state(&message(MonoTime::from_ns(7), &nothing)), Some(nothing));
    }

    #[test]
    fn a_message_of_another_shape_is_none() {
        let whole = message(MonoTime::from_ns(7), &learnt());
        let mut short = whole.clone();
        short.filter_covariance.pop();
        let mut uneven = whole.clone();
        uneven.offset_ns.pop();
        let mut longer = whole;
        longer.filter_mean.push(0.0);
        for message in [short, uneven, longer] {
            assert_eq!(state(&message), None);
        }
    }
}
