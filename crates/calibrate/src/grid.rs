//! Saddle points combined into the grid of a board: neighbours along edges, then rows and columns.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::Vector2;

use super::saddle::{FloatImage, Saddle};
use super::subpixel::{Window, refine};
use windhover_base::geo::wrap_angle;

/// Cell of a grid: (column, row), any origin.
pub(super) type Cell = (i32, i32);

/// Steps along the four edges of a saddle, in their order around the circle.
const STEPS: [Cell; 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];
/// Largest angle of a neighbour from the edge that leads to it, radians.
const MOST_ASIDE: f64 = 0.22;
/// Cost of such an angle of one radian, in lengths of the step.
const ASIDE_COST: f64 = 3.0;

/// Largest ratio between the edges of neighbouring squares.
const MOST_GROWTH: f64 = 1.7;

/// Corners by cell.
pub(super) type Grid = BTreeMap<Cell, Vector2<f64>>;

/// The grids that the saddles form, largest first, at most `most` of them, with gaps filled where the image has a
/// saddle.
pub(super) fn grids(blurred: &FloatImage, saddles: &[Saddle], radius: f64, most: usize) -> Vec<Grid> {
    let links = link(blurred, saddles);
    let mut seen = vec![false; saddles.len()];
    let mut found = Vec::new();
    for start in 0..saddles.len() {
        if !seen[start] {
            found.push(walk(saddles, &links, start, &mut seen));
        }
    }
    found.sort_by_key(|grid| std::cmp::Reverse(grid.len()));
    found.truncate(most);
    for grid in &mut found {
        shed(grid);
        fill(blurred, grid, radius);
        shed(grid);
    }
    found.sort_by_key(|grid| std::cmp::Reverse(grid.len()));
    found
}

/// Removes outermost rows and columns that are nearly empty: stray points beside the board.
fn shed(grid: &mut Grid) {
    while let Some((low, high)) = extent(grid) {
        let (wide, tall) = (high.0 - low.0 + 1, high.1 - low.1 + 1);
        let count = |line: &dyn Fn(&Cell) -> bool| grid.keys().filter(|c| line(c)).count();
        let is_stray = |n: usize, length: i32| n < grid.len() && 3 * n <= length as usize;
        if is_stray(count(&|c| c.0 == low.0), tall) {
            grid.retain(|c, _| c.0 != low.0);
        } else if is_stray(count(&|c| c.0 == high.0), tall) {
            grid.retain(|c, _| c.0 != high.0);
        } else if is_stray(count(&|c| c.1 == low.1), wide) {
            grid.retain(|c, _| c.1 != low.1);
        } else if is_stray(count(&|c| c.1 == high.1), wide) {
            grid.retain(|c, _| c.1 != high.1);
        } else {
            return;
        }
    }
}

/// For each saddle and edge: the saddle at its other end and the edge there that leads back.
type Links = Vec<[Option<(usize, usize)>; 4]>;

fn link(blurred: &FloatImage, saddles: &[Saddle]) -> Links {
    let chosen: Links = (0..saddles.len())
        .map(|a| std::array::from_fn(|edge| nearest_along(blurred, saddles, a, edge)))
        .collect();
    // Both ends must choose each other.
    let mutual =
        |a: usize, edge: usize| chosen[a][edge].filter(|&(b, back)| chosen[b][back] == Some((a, edge)));
    let links: Links = (0..saddles.len()).map(|a| std::array::from_fn(|edge| mutual(a, edge))).collect();
    let length = |a: usize, edge: usize| links[a][edge].map(|(b, _)| (saddles[b].px - saddles[a].px).norm());
    // Squares in a row change in size slowly: a link much longer than the previous one leaves the board.
    let in_step = |a: usize, edge: usize| match (length(a, edge), length(a, (edge + 2) % 4)) {
        (Some(this), Some(opposite)) => this < MOST_GROWTH * opposite,
        _ => true,
    };
    let kept =
        |a: usize, edge: usize| links[a][edge].filter(|&(b, back)| in_step(a, edge) && in_step(b, back));
    (0..saddles.len()).map(|a| std::array::from_fn(|edge| kept(a, edge))).collect()
}

fn nearest_along(blurred: &FloatImage, saddles: &[Saddle], a: usize, edge: usize) -> Option<(usize, usize)> {
    let from = &saddles[a];
    let direction = from.edges[edge];
    let mut candidates: Vec<(f64, usize, usize)> = Vec::new();
    for (b, to) in saddles.iter().enumerate().filter(|(b, _)| *b != a) {
        let v = to.px - from.px;
        let bearing = v.y.atan2(v.x);
        let aside = wrap_angle(bearing - direction).abs();
        if aside > MOST_ASIDE {
            continue;
        }
        let back = (0..4).find(|&k| {
            let off = wrap_angle(to.edges[k] - bearing - std::f64::consts::PI).abs();
            // The light side of an edge is the same at both ends.
            off < 2.0 * MOST_ASIDE && to.rises(k) != from.rises(edge)
        });
        if let Some(back) = back {
            candidates.push((v.norm() * (1.0 + ASIDE_COST * aside), b, back));
        }
    }
    candidates.sort_by(|x, y| x.0.total_cmp(&y.0));
    let is_edge = |b: usize| edge_holds(blurred, from.px, saddles[b].px, from.rises(edge));
    candidates.into_iter().take(3).find(|&(_, b, _)| is_edge(b)).map(|(_, b, back)| (b, back))
}

/// Whether the line between two corners has its light side where the first corner indicates.
fn edge_holds(blurred: &FloatImage, from: Vector2<f64>, to: Vector2<f64>, rises: bool) -> bool {
    let along = to - from;
    let aside = Vector2::new(-along.y, along.x) * 0.2;
    // A wide square is sampled near its edge: a shadow may fall across it.
    let aside = aside * (6.0 / aside.norm()).min(1.0);
    [0.3, 0.5, 0.7].into_iter().all(|share| {
        let at = from + along * share;
        match (blurred.sample(at + aside), blurred.sample(at - aside)) {
            (Some(ahead), Some(behind)) => (ahead > behind) == rises,
            _ => false,
        }
    })
}

/// Rows and columns of everything linked to `start`.
fn walk(saddles: &[Saddle], links: &Links, start: usize, seen: &mut [bool]) -> Grid {
    let mut grid = Grid::new();
    let mut queue = VecDeque::from([(start, (0, 0), 0usize)]);
    seen[start] = true;
    grid.insert((0, 0), saddles[start].px);
    // `turn` is the step of the saddle's first edge.
    while let Some((a, cell, turn)) = queue.pop_front() {
        for (edge, end) in links[a].iter().enumerate() {
            let Some((b, back)) = *end else { continue };
            let taken = (edge + turn) % 4;
            let next = (cell.0 + STEPS[taken].0, cell.1 + STEPS[taken].1);
            if seen[b] || grid.contains_key(&next) {
                continue;
            }
            seen[b] = true;
            grid.insert(next, saddles[b].px);
            queue.push_back((b, next, (taken + 2 + 4 - back) % 4));
        }
    }
    grid
}

/// Adds corners next to known ones where straight continuation leads to a saddle.
fn fill(blurred: &FloatImage, grid: &mut Grid, radius: f64) {
    loop {
        let mut wanted: Vec<Cell> = grid.keys().flat_map(|c| STEPS.map(|s| (c.0 + s.0, c.1 + s.1))).collect();
        wanted.sort_unstable();
        wanted.dedup();
        wanted.retain(|cell| !grid.contains_key(cell));
        let mut added = false;
        for cell in wanted {
            let Some((expected, spacing)) = continuation(grid, cell) else { continue };
            let reach = (0.3 * spacing).max(2.0);
            let Some(px) = refine(blurred, expected, Window::square(reach.min(8.0))) else { continue };
            let close = (px - expected).norm() < 0.3 * spacing;
            if close && Saddle::at(blurred, px, radius.min(0.45 * spacing).max(2.0)).is_some() {
                grid.insert(cell, px);
                added = true;
            }
        }
        if !added {
            return;
        }
    }
}

/// The predicted place of a cell from the lines through its neighbours, and the distance of its neighbours.
fn continuation(grid: &Grid, cell: Cell) -> Option<(Vector2<f64>, f64)> {
    let at = |k: i32, s: Cell| grid.get(&(cell.0 + k * s.0, cell.1 + k * s.1));
    let mut guesses: Vec<(Vector2<f64>, f64)> = Vec::new();
    for s in STEPS {
        if let (Some(near), Some(far)) = (at(1, s), at(2, s)) {
            // A third point gives the change of spacing with perspective.
            let bend = at(3, s).map_or(Vector2::zeros(), |third| near - far * 2.0 + third);
            guesses.push((near * 2.0 - far + bend, (near - far).norm()));
        }
    }
    for s in &STEPS[..2] {
        if let (Some(one), Some(other)) = (at(1, *s), at(-1, *s)) {
            guesses.push(((one + other) / 2.0, (one - other).norm() / 2.0));
        }
    }
    let n = guesses.len() as f64;
    let sum = guesses.iter().fold((Vector2::zeros(), f64::INFINITY), |sum, g| (sum.0 + g.0, sum.1.min(g.1)));
    (!guesses.is_empty()).then(|| (sum.0 / n, sum.1))
}

/// Columns and rows of a grid, smallest and largest.
pub(super) fn extent(grid: &Grid) -> Option<(Cell, Cell)> {
    let first = *grid.keys().next()?;
    Some(grid.keys().fold((first, first), |(low, high), c| {
        ((low.0.min(c.0), low.1.min(c.1)), (high.0.max(c.0), high.1.max(c.1)))
    }))
}
