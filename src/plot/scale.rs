//! The scale of one axis from data to picture, and its round tick values.

/// A linear scale: data `low..high` to picture coordinates `from..to`.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Scale {
    /// Data at `from`.
    pub low: f64,
    /// Data at `to`.
    pub high: f64,
    /// Picture coordinate of `low`.
    pub from: f64,
    /// Picture coordinate of `high`.
    pub to: f64,
}

/// With fewer ticks on an axis, values between them are hard to read.
const LEAST_TICKS: f64 = 3.0;

impl Scale {
    /// Picture coordinate of a data value.
    pub fn at(&self, value: f64) -> f64 {
        self.from + (value - self.low) / (self.high - self.low) * (self.to - self.from)
    }

    /// Round values (1, 2 or 5 times a power of ten apart) inside the scale, about `wanted` of them and at least enough
    /// to show the scale.
    pub fn ticks(&self, wanted: usize) -> Vec<f64> {
        let raw = (self.high - self.low) / wanted.max(1) as f64;
        let inside = |step: f64| (self.high / step).floor() - (self.low / step).ceil() + 1.0;
        let step = Some(round_step(raw)).filter(|s| inside(*s) >= LEAST_TICKS);
        let step = step.unwrap_or_else(|| round_step(0.5 * raw));
        if !(step > 0.0) || !step.is_finite() {
            return Vec::new();
        }
        let first = (self.low / step - 1e-9).ceil() as i64;
        let last = (self.high / step + 1e-9).floor() as i64;
        (first..=last).take(100).map(|k| k as f64 * step).collect()
    }

    /// A tick's number, with just the decimals that distinguish it from its neighbours.
    pub fn label(value: f64, step: f64) -> String {
        let decimals = (-(step.abs().max(1e-12)).log10().floor()).clamp(0.0, 9.0) as usize;
        // Adding zero turns minus zero into zero.
        let text = format!("{:.decimals$}", value + 0.0);
        text.replace('-', "\u{2212}")
    }
}

/// The smallest of 1, 2, 5 times a power of ten that is at least `raw`.
fn round_step(raw: f64) -> f64 {
    if !(raw > 0.0) || !raw.is_finite() {
        return 0.0;
    }
    let power = 10f64.powf(raw.log10().floor());
    let factor = [1.0, 2.0, 5.0].into_iter().find(|f| f * power >= raw * (1.0 - 1e-9)).unwrap_or(10.0);
    factor * power
}

/// The range of the finite values, widened by `margin` of itself; a unit range around a single value.
pub(super) fn range(values: impl Iterator<Item = f64>, margin: f64) -> (f64, f64) {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for value in values.filter(|v| v.is_finite()) {
        low = low.min(value);
        high = high.max(value);
    }
    if low > high {
        return (0.0, 1.0);
    }
    let width = high - low;
    if width <= 1e-9 * high.abs().max(1e-9) {
        let half = (0.05 * high.abs()).max(0.5);
        return (low - half, high + half);
    }
    (low - margin * width, high + margin * width)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let scale = Scale { low: -0.37, high: 2.1, from: 0.0, to: 100.0 };
        assert_eq!(scale.ticks(5), vec![0.0, 0.5, 1.0, 1.5, 2.0]);
        let low = Scale { low: -0.49, high: 0.47, from: 0.0, to: 100.0 };
        assert_eq!(low.ticks(3), vec![-0.4, -0.2, 0.0, 0.2, 0.4]);
        assert_eq!(Scale::label(-0.5, 0.5), "\u{2212}0.5");
        assert_eq!(Scale::label(20.0, 20.0), "20");
    }

    #[test]
    fn nothing_and_one_value_still_have_a_range() {
        assert_eq!(range([f64::NAN].into_iter(), 0.1), (0.0, 1.0));
        let (low, high) = range([3.0, 3.0].into_iter(), 0.1);
        assert!(low < 3.0 && high > 3.0);
    }
}
