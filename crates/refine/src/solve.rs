//! The values with the best fit: Gauss–Newton steps, damped (Marquardt 1963) where the model is too nonlinear.

use std::borrow::Cow;

use crate::block::{Block, Loss, Noise};
use crate::dense::Singular;
use crate::front::{Back, Eliminated, Front};
use crate::problem::{Origin, Pass};
use crate::values::Values;

/// Most steps, and the increase of the diagonal after a step that made the fit worse.
const STEPS: usize = 25;
const RAISED: (f64, f64, f64) = (1e-4, 10.0, 1e6);
/// Prior information about a landmark, 1/m².
pub(crate) const LANDMARK: f64 = 1e-8;

/// The kind of eliminated unknowns.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum EliminatedKind {
    Knot(usize),
    Landmark(usize),
    /// The displacement of the frame at a knot.
    Shake(usize),
    Constants,
}

/// An elimination.
pub(crate) type Step = (EliminatedKind, Eliminated);

/// The factorised normal equations at some values.
///
/// Of a long flight only the last segment is kept, and of each earlier one the front at its begin: a backward pass
/// eliminates it once more. So memory hardly grows with the length.
pub(crate) struct Factors {
    /// Eliminations of the last segment, and of the constants.
    last: Vec<Step>,
    /// The front at the begin of every segment.
    begins: Vec<Front>,
    raised: f64,
    pub(crate) cost: f64,
    gain: f64,
}

impl Factors {
    /// By how much the sum of squares is reduced by the solution.
    pub(crate) fn gain(&self) -> f64 {
        self.gain
    }

    /// Number of segments.
    pub(crate) fn segments(&self) -> usize {
        self.begins.len()
    }

    /// The eliminations of a segment, at the same values.
    pub(crate) fn segment(
        &self,
        index: usize,
        pass: &mut Pass<'_>,
        values: &Values,
        noise: &Noise,
    ) -> Result<Cow<'_, [Step]>, Unsolved> {
        if index + 1 == self.segments() {
            return Ok(Cow::Borrowed(&self.last));
        }
        let mut front = self.begins[index].clone();
        let mut steps = Vec::new();
        for k in pass.problem.segment(index) {
            eliminate_knot(pass, (k, values, noise), self.raised, &mut front, &mut steps)?;
        }
        Ok(Cow::Owned(steps))
    }
}

/// The caller's callback: gets the completed share; returns whether to continue.
pub(crate) type Watch<'a> = &'a mut dyn FnMut(usize) -> bool;

/// Why there is no solution.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Unsolved {
    Singular,
    Stopped,
}

impl From<Singular> for Unsolved {
    fn from(_: Singular) -> Self {
        Self::Singular
    }
}

/// Forms the normal equations at the values, and eliminates all unknowns.
pub(crate) fn factorise(
    pass: &mut Pass<'_>,
    values: &Values,
    noise: &Noise,
    raised: f64,
    watch: Watch<'_>,
) -> Result<Factors, Unsolved> {
    let problem = pass.problem;
    let shape = problem.shape;
    pass.begin(values);
    let mut front = Front::new(shape);
    let mut factors = Factors {
        cost: pass.constants(values, &mut front),
        last: Vec::new(),
        begins: Vec::new(),
        raised,
        gain: 0.0,
    };
    for index in 0..problem.segments() {
        factors.begins.push(front.clone());
        factors.last.clear();
        for k in problem.segment(index) {
            factors.cost += eliminate_knot(pass, (k, values, noise), raised, &mut front, &mut factors.last)?;
            if !watch(k) {
                return Err(Unsolved::Stopped);
            }
        }
        factors.gain += factors.last.iter().map(|(_, e)| e.gain()).sum::<f64>();
    }
    let constants = front.eliminate(shape.constants_at(), shape.constants, raised)?;
    factors.gain += constants.gain();
    factors.last.push((EliminatedKind::Constants, constants));
    Ok(factors)
}

/// Adds everything of a knot, eliminates it and the landmarks that were seen last there; returns its cost.
fn eliminate_knot(
    pass: &mut Pass<'_>,
    (k, values, noise): (usize, &Values, &Noise),
    raised: f64,
    front: &mut Front,
    steps: &mut Vec<Step>,
) -> Result<f64, Unsolved> {
    let problem = pass.problem;
    let (shape, gates) = (problem.shape, problem.gates);
    let mut cost = pass.beginnings(k, values, noise, front);
    pass.blocks(k, values, noise, &mut |origin: Origin, block: &Block| {
        let square = block.square();
        let loss = match origin.source.is_measured() {
            true => Loss::of(square, gates[block.len()]),
            false => Loss { weight: 1.0, cost: square },
        };
        cost += loss.cost;
        front.add(&block.columns, &block.rows, &block.right, loss.weight);
    });
    if problem.is_displaced(k) {
        steps.push((EliminatedKind::Shake(k), front.eliminate(shape.shake_at(), shape.shake, raised)?));
    }
    steps.push((EliminatedKind::Knot(k), front.eliminate(shape.knot_at(k), shape.knot, raised)?));
    for (place, landmark) in &problem.plan.stops[k].closes {
        let first = shape.landmark_at(*place);
        (0..2).for_each(|i| front.hold(first + i, LANDMARK));
        steps.push((EliminatedKind::Landmark(*landmark), front.eliminate(first, 2, raised)?));
    }
    Ok(cost)
}

/// Changes the values until they fit best: until a step's expected reduction of the sum of squares is below `enough`.
pub(crate) fn solve(
    pass: &mut Pass<'_>,
    values: &mut Values,
    noise: &Noise,
    enough: f64,
    watch: Watch<'_>,
) -> Result<Factors, Unsolved> {
    let mut raised = 0.0;
    let mut best: Option<(Values, f64)> = None;
    for step in 0.. {
        let factors = factorise(pass, values, noise, raised, watch)?;
        let worse = best.as_ref().is_some_and(|(_, cost)| !(factors.cost <= cost * (1.0 + 1e-9)));
        if worse && let Some((before, _)) = &best {
            raised = f64::max(RAISED.0, raised * RAISED.1);
            values.clone_from(before);
            if raised <= RAISED.2 && step < STEPS {
                best = None;
                continue;
            }
            return factorise(pass, values, noise, 0.0, watch);
        }
        if factors.gain() < enough || step >= STEPS {
            return if raised == 0.0 { Ok(factors) } else { factorise(pass, values, noise, 0.0, watch) };
        }
        raised = if raised > RAISED.0 { raised / RAISED.1 } else { 0.0 };
        best = Some((values.clone(), factors.cost));
        apply(pass, &factors, values, noise)?;
    }
    unreachable!("the loop ends by its steps")
}

/// Changes the values by the solution.
pub(crate) fn apply(
    pass: &mut Pass<'_>,
    factors: &Factors,
    values: &mut Values,
    noise: &Noise,
) -> Result<(), Unsolved> {
    let mut back = Back::new(pass.problem.shape);
    // Segments that are eliminated once more have links to knots that were changed already.
    let before = values.clone();
    for index in (0..factors.segments()).rev() {
        for (what, e) in factors.segment(index, pass, &before, noise)?.iter().rev() {
            back.solve(e);
            values.step(*what, &back.x[e.range()]);
        }
    }
    Ok(())
}

impl Values {
    fn step(&mut self, what: EliminatedKind, dx: &[f64]) {
        match what {
            EliminatedKind::Knot(k) => self.knots[k].step(dx),
            EliminatedKind::Landmark(l) => self.landmarks[l].iter_mut().zip(dx).for_each(|(x, d)| *x += d),
            EliminatedKind::Shake(k) => self.shakes[k].iter_mut().zip(dx).for_each(|(x, d)| *x += d),
            EliminatedKind::Constants => self.constants.iter_mut().zip(dx).for_each(|(x, d)| *x += d),
        }
    }
}
