//! Which parts are up, and from this whether the daemon is ready.

use std::sync::{Arc, Mutex, PoisonError};

use crate::config::Part;

/// State of a part.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub enum PartState {
    /// Not tried yet.
    #[default]
    Waiting,
    /// Open; nothing delivered yet.
    Open,
    /// It delivers.
    Delivers,
    /// It does not deliver; the reason in one word.
    Down(String),
}

impl PartState {
    /// The state in one word.
    pub fn word(&self) -> &str {
        match self {
            Self::Waiting => "waiting",
            Self::Open => "open",
            Self::Delivers => "ok",
            Self::Down(why) => why,
        }
    }
}

/// Which parts are up. Copies share the same state.
#[derive(Clone, Debug, Default)]
pub struct Presence(Arc<Mutex<[PartState; Part::ALL.len()]>>);

impl Presence {
    /// Sets a part's state; returns the previous one.
    pub fn set(&self, part: Part, state: PartState) -> PartState {
        let mut board = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut board[part as usize], state)
    }

    /// A part's state.
    pub fn get(&self, part: Part) -> PartState {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)[part as usize].clone()
    }

    /// Parts that are not up and are not optional.
    pub fn missing(&self, optional: &[Part]) -> Vec<(Part, PartState)> {
        let wanted = Part::ALL.into_iter().filter(|part| !optional.contains(part));
        let states = wanted.map(|part| (part, self.get(part)));
        states.filter(|(_, state)| *state != PartState::Delivers).collect()
    }

    /// Missing parts as text: `gps missing, camera waiting`.
    pub fn words(missing: &[(Part, PartState)]) -> String {
        let words: Vec<String> =
            missing.iter().map(|(part, state)| format!("{} {}", part.name(), state.word())).collect();
        words.join(", ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ready_when_all_that_is_wanted_delivers() {
        let board = Presence::default();
        assert_eq!(board.missing(&[]).len(), 5);
        for part in [Part::Gps, Part::Camera, Part::Autopilot, Part::Store] {
            board.set(part, PartState::Delivers);
        }
        board.set(Part::Compass, PartState::Down("unplugged".into()));
        assert_eq!(Presence::words(&board.missing(&[])), "compass unplugged");
        assert!(board.missing(&[Part::Compass]).is_empty());
    }
}
