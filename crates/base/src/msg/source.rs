//! The table of sources: every sensor that delivers events, one row for each.

use crate::time::Span;

/// The form in which a source delivers.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Delivery {
    /// Bytes of a line, in the portions of the reads.
    Bytes,
    /// Camera frames.
    Frames,
    /// Samples of rates and forces.
    Inertial,
    /// Samples of attitude.
    Attitude,
}

/// The constants of a source.
#[derive(Clone, Copy, PartialEq, Debug)]
struct SourceRow {
    name: &'static str,
    delivers: Delivery,
    topic: &'static str,
    silent_after: Span,
}

/// One row for each source; the enum and all code that iterates over the sources use these rows.
macro_rules! sources {
    ($($(#[$doc:meta])* $source:ident: $name:literal, $delivers:ident, $topic:literal, silent after $ms:literal ms;)+) => {
        /// The source of an event.
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
        pub enum Source {
            $($(#[$doc])* $source,)+
        }

        impl Source {
            /// Every source, in the order in which health lists them.
            pub const ALL: &'static [Self] = &[$(Self::$source),+];

            const fn row(self) -> SourceRow {
                match self {
                    $(Self::$source => SourceRow {
                        name: $name,
                        delivers: Delivery::$delivers,
                        topic: $topic,
                        silent_after: Span::from_ns($ms * 1_000_000),
                    },)+
                }
            }
        }
    };
}

sources! {
    /// GPS receiver.
    Gps: "gps", Bytes, "/gps/serial", silent after 1500 ms;
    /// Digital compass.
    Compass: "compass", Bytes, "/compass/serial", silent after 1500 ms;
    /// Camera.
    Camera: "camera", Frames, "/camera/image", silent after 1500 ms;
    /// Gyros and accelerometers.
    Imu: "imu", Inertial, "/imu/samples", silent after 1500 ms;
    /// Second source of attitude.
    Attitude: "attitude", Attitude, "/attitude/samples", silent after 1500 ms;
    /// The helicopter's autopilot.
    Autopilot: "autopilot", Bytes, "/autopilot/mavlink", silent after 2500 ms;
}

impl Source {
    /// Its fixed name in logs, health and files.
    pub const fn name(self) -> &'static str {
        self.row().name
    }

    /// The form in which it delivers.
    pub const fn delivers(self) -> Delivery {
        self.row().delivers
    }

    /// Topic of its events.
    pub const fn topic(self) -> &'static str {
        self.row().topic
    }

    /// It is silent when it has delivered nothing usable for this long.
    pub const fn silent_after(self) -> Span {
        self.row().silent_after
    }

    /// The source of that name.
    ///
    /// ```
    /// use windhover_base::msg::Source;
    ///
    /// assert_eq!(Source::named("gps"), Some(Source::Gps));
    /// assert_eq!(Source::named("sonar"), None);
    /// ```
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|source| source.name() == name)
    }

    /// The source that delivers on a topic.
    pub fn on_topic(topic: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|source| source.topic() == topic)
    }
}

/// One value for each source.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct PerSource<T>(Vec<T>);

impl<T: Default> Default for PerSource<T> {
    fn default() -> Self {
        Self(Source::ALL.iter().map(|_| T::default()).collect())
    }
}

impl<T> std::ops::Index<Source> for PerSource<T> {
    type Output = T;

    fn index(&self, source: Source) -> &T {
        &self.0[source as usize]
    }
}

impl<T> std::ops::IndexMut<Source> for PerSource<T> {
    fn index_mut(&mut self, source: Source) -> &mut T {
        &mut self.0[source as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_source_is_found_by_its_name_and_topic() {
        for &source in Source::ALL {
            assert_eq!(Source::named(source.name()), Some(source));
            assert_eq!(Source::on_topic(source.topic()), Some(source));
        }
        assert_eq!((Source::named("sonar"), Source::on_topic("/tf")), (None, None));
    }

    #[test]
    fn every_source_has_a_value_of_its_own() {
        let mut counts = PerSource::<usize>::default();
        for (n, &source) in Source::ALL.iter().enumerate() {
            counts[source] += n;
        }
        assert!(Source::ALL.iter().enumerate().all(|(n, &source)| counts[source] == n));
    }
}
