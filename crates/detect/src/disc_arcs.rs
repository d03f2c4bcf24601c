//! Circles of which an outline shows a part: a shadow's edge cuts a disc, a light strip joins it to what is beside it.

use nalgebra::Vector2;

use super::components::{Component, Outline};

/// A circle: middle and radius, pixels.
pub(super) type Circle = (Vector2<f64>, f64);

/// Where along an outline arcs are tried to begin, and the shares of it that they are as long as.
const BEGINS: usize = 16;
const SPANS: [f64; 3] = [0.12, 0.25, 0.45];

/// Parts of a circle of which an arc must show so many.
const PARTS: usize = 24;
const LEAST_PARTS: u32 = 8;

/// How far an outline may be from a circle: pixels, and a share of the radius, for discs are seen aslant.
const ASIDE_PX: f64 = 0.8;
const ASIDE_SHARE: f64 = 0.05;

/// Most circles looked for in one outline.
const MOST: usize = 3;

/// Finds circles in outlines; keeps its buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Arcs {
    points: Vec<Vector2<f64>>,
}

impl Arcs {
    /// Calls `found` with the circles that parts of an outline lie on, their radius within `radii`.
    pub fn find(
        &mut self,
        component: &Component,
        outline: Outline<'_>,
        radii: (f64, f64),
        mut found: impl FnMut(Circle),
    ) {
        let top = f64::from(component.top);
        let at = |u: f64, row: usize| Vector2::new(u, top + row as f64);
        self.points.clear();
        let rows = || outline.iter().enumerate();
        // Clockwise as seen: down the right side, up the left.
        self.points.extend(rows().map(|(row, lr)| at(f64::from(lr.1) + 0.5, row)));
        self.points.extend(rows().rev().map(|(row, lr)| at(f64::from(lr.0) - 0.5, row)));
        for _ in 0..MOST {
            let Some(circle) = self.best(radii) else { return };
            found(circle);
            self.points.retain(|p| !is_on(&circle, p));
        }
    }

    /// The circle that most of the outline lies on.
    fn best(&self, radii: (f64, f64)) -> Option<Circle> {
        let n = self.points.len();
        if n < 12 {
            return None;
        }
        let mut best: Option<(u32, Circle)> = None;
        for (span, begin) in SPANS.iter().flat_map(|span| (0..BEGINS).map(move |begin| (span, begin))) {
            let (first, span) = (n * begin / BEGINS, (span * n as f64) as usize);
            let arc = [0, span / 2, span].map(|k| self.points[(first + k) % n]);
            let Some(circle) = through(arc).filter(|c| (radii.0..=radii.1).contains(&c.1)) else { continue };
            let parts = self.parts_of(&circle);
            if parts >= LEAST_PARTS && best.is_none_or(|b| parts > b.0) {
                best = Some((parts, circle));
            }
        }
        best.map(|b| b.1)
    }

    /// On how many parts of a circle there are points.
    fn parts_of(&self, circle: &Circle) -> u32 {
        let seen = self.points.iter().filter(|p| is_on(circle, p)).fold(0u32, |seen, p| {
            let d = p - circle.0;
            let turn = d.y.atan2(d.x) / std::f64::consts::TAU + 0.5;
            seen | 1 << ((turn * PARTS as f64) as usize % PARTS)
        });
        seen.count_ones()
    }
}

fn is_on(&(middle, radius): &Circle, p: &Vector2<f64>) -> bool {
    ((p - middle).norm() - radius).abs() < ASIDE_PX + ASIDE_SHARE * radius
}

/// The circle through three points, clockwise as seen; `None` where they are on a line or run the other way.
fn through([a, b, c]: [Vector2<f64>; 3]) -> Option<Circle> {
    let (p, q) = (b - a, c - a);
    let double = 2.0 * p.perp(&q);
    if !(double > 1e-6) {
        return None;
    }
    let (pp, qq) = (p.norm_squared(), q.norm_squared());
    let from_a = Vector2::new(q.y * pp - p.y * qq, p.x * qq - q.x * pp) / double;
    Some((a + from_a, from_a.norm()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_a_disc_and_two_that_are_joined_show_their_circles() {
        // Given half a disc, and two discs that a strip joins.
        let row = |v: i32, middle: (i32, i32), radius: i32| {
            let reach = radius * radius - (v - middle.1).pow(2);
            (reach >= 0).then(|| (f64::from(reach).sqrt() as i32, middle.0))
        };
        let half: Vec<(u16, u16)> = (20..=60)
            .filter_map(|v| row(v, (40, 40), 20).map(|(reach, u)| ((u - reach) as u16, u as u16 + 3)))
            .collect();
        let joined: Vec<(u16, u16)> = (20..=130)
            .map(|v| {
                let spans = [row(v, (40, 40), 20), row(v, (44, 100), 30), Some((3, 42))];
                let edge = |sign: i32| spans.iter().flatten().map(move |(reach, u)| u + sign * reach);
                (edge(-1).min().unwrap_or(0) as u16, edge(1).max().unwrap_or(0) as u16)
            })
            .collect();
        let circles = |outline: &[(u16, u16)]| {
            let component = Component { top: 20, bottom: 19 + outline.len() as u16, ..Component::default() };
            let mut circles = Vec::new();
            Arcs::default().find(&component, outline, (8.0, 60.0), |c| circles.push(c));
            circles
        };
        // Then their circles are among those found, good enough to begin with.
        let has = |circles: &[Circle], at: (f64, f64), radius: f64| {
            let near = |c: &&Circle| (c.0 - Vector2::new(at.0, at.1)).norm() < 0.15 * radius;
            circles.iter().find(near).is_some_and(|c| (c.1 / radius - 1.0).abs() < 0.12)
        };
        assert!(has(&circles(&half), (40.0, 40.0), 20.0), "{:?}", circles(&half));
        let found = circles(&joined);
        assert!(has(&found, (40.0, 40.0), 20.0) && has(&found, (44.0, 100.0), 30.0), "{found:?}");
    }
}
