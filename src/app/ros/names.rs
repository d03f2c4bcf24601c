//! Names in characters that ROS allows.

use std::collections::BTreeMap;

/// Most names: a configuration has at most half as many targets.
const NAMES: usize = 64;

/// Names as ROS allows them in topics: letters, digits and `_`, no digit first, all different.
pub struct RosNames {
    before: &'static str,
    names: BTreeMap<String, String>,
}

impl RosNames {
    /// Names before which `before` stands where they would begin otherwise than with a letter.
    pub fn with(before: &'static str) -> Self {
        Self { before, names: BTreeMap::new() }
    }

    /// The name for ROS. `None` where there are too many.
    pub fn of(&mut self, original: &str) -> Option<String> {
        if let Some(known) = self.names.get(original) {
            return Some(known.clone());
        }
        if self.names.len() >= NAMES {
            return None;
        }
        let allowed = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
        let mut name: String = original.chars().map(allowed).collect();
        if !name.starts_with(|c: char| c.is_ascii_alphabetic()) {
            name.insert_str(0, self.before);
        }
        while name.contains("__") {
            name = name.replace("__", "_");
        }
        while self.names.values().any(|taken| *taken == name) {
            name += "x";
        }
        self.names.insert(original.to_owned(), name.clone());
        Some(name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_targets_are_names_of_ros() {
        let mut names = RosNames::with("target_");
        let named = ["ugv", "my-ugv", "my_ugv", "2nd", "a--b"].map(|name| names.of(name));
        assert_eq!(
            named,
            ["ugv", "my_ugv", "my_ugvx", "target_2nd", "a_b"].map(|name| Some(name.to_owned()))
        );
        assert_eq!(names.of("my_ugv").as_deref(), Some("my_ugvx"));
        let many = (0..2 * NAMES).filter_map(|n| names.of(&format!("t{n}"))).count();
        assert_eq!(many, NAMES - 5);
    }
}
