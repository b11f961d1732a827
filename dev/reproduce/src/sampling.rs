//! How many points the value function of a plant needs as its states grow in number: what the thesis leaves open in
//! chapter 5. The thesis's plant of section 4.3.3.2 in n states, whose value function is known and not a polynomial.

use anyhow::{Context, Result};
use greybox_hjb::{
    Domain, Feedback, HjbError, Linear, Monomials, Plant, PolicyOptions, Problem, lqr, policy_iteration,
    tangent,
};
use nalgebra::{DMatrix, DVector};
use rand_distr::{Distribution, Uniform};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;

use super::chapter2::draw;
use super::index::number;
use super::{Check, Entry, Piece, Status, Table};
use greybox_dev::figure::{Axis, Series, Style};

/// States and degree of the bases.
const CASES: [(usize, u8); 10] =
    [(2, 4), (2, 6), (3, 4), (3, 6), (4, 4), (4, 6), (5, 4), (5, 6), (6, 4), (8, 4)];
/// Points per basis function.
const SHARES: [f64; 7] = [1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 8.0];
/// Points per basis function, and points at the least, whose errors count as those of any number of points.
const MANY: (usize, usize) = (8, 2000);
/// Most functions of a basis for which the largest share of points is tried.
const LARGE: usize = 200;
/// Most points of a grid per basis function.
const LARGEST_GRID: f64 = 16.0;
/// Draws of random points.
const SEEDS: std::ops::Range<u64> = 0..3;
/// The law and its value are judged at this many random points.
const JUDGED: usize = 1000;
/// The share of points is enough from which on the errors are within this factor of those of many points.
const FACTOR: f64 = 2.0;
/// Weight of the part of V that is no polynomial.
const COSINE: f64 = 0.5;
/// States of the linear plants.
const LINEAR: [usize; 5] = [2, 4, 6, 8, 10];

const HEADINGS: [&str; 10] = [
    "states",
    "degree",
    "functions",
    "V, best weights",
    "V",
    "u",
    "Halton",
    "random, worst of 3",
    "grid",
    "least grid",
];

/// The piece.
pub(crate) fn entry() -> Entry {
    Entry::new("Sampling", |_| piece()).slow()
}

/// Equations 4.45 to 4.51 in n states: V = Σ pᵢ xᵢ² + ½ Σ (1 − cos(xᵢ + xᵢ₊₁)) with p = ½, 1, ½, …, costs Q = I and
/// R = 1, and one input g = (0, …, 0, cos 2x₁ + 2). With two states and without the cosines it is the thesis's plant.
///
/// ∇V = M(x) x with a positive definite M, and f = ¼ g gᵀ∇V − M⁻¹x + S ∇V with a skew S solves the
/// Hamilton–Jacobi–Bellman equation ∇Vᵀf − ¼ (gᵀ∇V)² + xᵀx = 0.
struct Known {
    states: usize,
}

impl Known {
    fn square(i: usize) -> f64 {
        if i.is_multiple_of(2) { 0.5 } else { 1.0 }
    }

    fn gain(x: &[f64]) -> f64 {
        (2.0 * x[0]).cos() + 2.0
    }

    fn value(x: &[f64]) -> f64 {
        let squares: f64 = x.iter().enumerate().map(|(i, x)| Self::square(i) * x * x).sum();
        squares + x.windows(2).map(|x| COSINE * (1.0 - (x[0] + x[1]).cos())).sum::<f64>()
    }

    fn gradient(x: &[f64]) -> Vec<f64> {
        let mut v: Vec<f64> = x.iter().enumerate().map(|(i, x)| 2.0 * Self::square(i) * x).collect();
        for i in 1..x.len() {
            let force = COSINE * (x[i - 1] + x[i]).sin();
            v[i - 1] += force;
            v[i] += force;
        }
        v
    }

    /// M, of ∇V = M x.
    fn secant(x: &[f64]) -> DMatrix<f64> {
        let n = x.len();
        let mut m = DMatrix::from_fn(n, n, |i, j| if i == j { 2.0 * Self::square(i) } else { 0.0 });
        for i in 1..n {
            let z = x[i - 1] + x[i];
            // sin z / z, whose series ends within rounding below 1e-4.
            let s = COSINE * if z.abs() < 1e-4 { 1.0 - z * z / 6.0 } else { z.sin() / z };
            for (row, column) in [(i - 1, i - 1), (i - 1, i), (i, i - 1), (i, i)] {
                m[(row, column)] += s;
            }
        }
        m
    }

    /// The optimal input.
    fn control(&self, x: &[f64]) -> f64 {
        -0.5 * Self::gain(x) * Self::gradient(x)[self.states - 1]
    }
}

impl Plant for Known {
    fn states(&self) -> usize {
        self.states
    }

    fn inputs(&self) -> usize {
        1
    }

    fn drift(&self, x: &[f64], f: &mut [f64]) {
        let (n, v) = (self.states, Self::gradient(x));
        match Self::secant(x).cholesky() {
            Some(m) => f.copy_from_slice((-m.solve(&DVector::from_row_slice(x))).as_slice()),
            None => f.fill(f64::NAN),
        }
        for i in 1..n {
            f[i - 1] += 0.5 * v[i];
            f[i] -= 0.5 * v[i - 1];
        }
        f[n - 1] += 0.25 * Self::gain(x).powi(2) * v[n - 1];
    }

    fn input(&self, x: &[f64], g: &mut [f64]) {
        g.fill(0.0);
        g[self.states - 1] = Self::gain(x);
    }
}

/// `count` random points of [−1, 1]ⁿ.
fn random(states: usize, count: usize, seed: u64) -> Result<Vec<Vec<f64>>> {
    let (uniform, mut generator) = (Uniform::new(-1.0, 1.0)?, Pcg64Mcg::seed_from_u64(seed));
    Ok((0..count).map(|_| (0..states).map(|_| uniform.sample(&mut generator)).collect()).collect())
}

/// Root mean square errors of V and u over those of the true ones.
#[derive(Debug, Clone, Copy)]
struct Errors {
    value: f64,
    law: f64,
}

impl Errors {
    /// Errors so large that the weights are not determined.
    const NONE: Errors = Errors { value: f64::INFINITY, law: f64::INFINITY };

    /// The larger of both over those of many points.
    fn over(self, many: Errors) -> f64 {
        (self.value / many.value).max(self.law / many.law)
    }
}

/// A plant with a basis.
struct Experiment {
    plant: Known,
    basis: Monomials,
    domain: Domain,
    judged: Vec<Vec<f64>>,
}

impl Experiment {
    fn new(states: usize, degree: u8) -> Result<Self> {
        Ok(Self {
            plant: Known { states },
            basis: Monomials::even(states, degree)?,
            domain: Domain::symmetric(&vec![1.0; states])?,
            judged: random(states, JUDGED, SEEDS.end)?,
        })
    }

    /// Weights by policy iteration from the regulator of the tangent plant, all of them free as in the thesis; `None`
    /// where the points do not determine them.
    fn errors(&self, points: &[Vec<f64>]) -> Result<Errors> {
        let n = self.plant.states;
        let (q, r) = (DMatrix::identity(n, n), DMatrix::identity(1, 1));
        let Linear { a, b } = tangent(&self.plant, &vec![1.0; n]);
        let riccati = lqr(&a, &b, &q, &r)?.solution;
        let start = self.basis.quadratic(|i, j| riccati[(i, j)]);
        let problem = Problem::new(&self.plant, &q, &r, self.basis.clone(), points)?;
        let options = PolicyOptions { tolerance: 1e-6, ..PolicyOptions::default() };
        let weights = match policy_iteration(&problem, &start, options) {
            Ok(policy) => policy.weights,
            Err(HjbError::Undetermined { .. }) => return Ok(Errors::NONE),
            Err(other) => return Err(other.into()),
        };
        let feedback = Feedback::new(self.basis.clone(), weights, &r)?;
        let mut g = vec![0.0; n];
        let (mut value, mut law) = ((0.0, 0.0), (0.0, 0.0));
        for x in &self.judged {
            self.plant.input(x, &mut g);
            for (sums, found, truth) in [
                (&mut value, feedback.value(x), Known::value(x)),
                (&mut law, feedback.control(x, &g)[0], self.plant.control(x)),
            ] {
                sums.0 += (found - truth).powi(2);
                sums.1 += truth * truth;
            }
        }
        let relative = |sums: (f64, f64)| (sums.0 / sums.1).sqrt();
        Ok(Errors { value: relative(value), law: relative(law) })
    }

    /// The error of V of the best weights: of V itself, in the least-squares sense at many random points.
    fn best(&self) -> Result<f64> {
        let count = self.basis.len();
        let points = random(self.plant.states, (4 * count).max(JUDGED), SEEDS.end + 1)?;
        let functions = |x: &[f64]| -> Vec<f64> {
            self.basis
                .exponents()
                .map(|e| e.iter().zip(x).map(|(e, x)| x.powi(i32::from(*e))).product())
                .collect()
        };
        let rows: Vec<f64> = points.iter().flat_map(|x| functions(x)).collect();
        let qr = DMatrix::from_row_slice(points.len(), count, &rows).qr();
        let values = DVector::from_iterator(points.len(), points.iter().map(|x| Known::value(x)));
        let weights =
            qr.r().solve_upper_triangular(&(qr.q().transpose() * values)).context("a singular R")?;
        let (mut error, mut size) = (0.0, 0.0);
        for x in &self.judged {
            error += (self.basis.value(weights.as_slice(), x) - Known::value(x)).powi(2);
            size += Known::value(x).powi(2);
        }
        Ok(f64::sqrt(error / size))
    }
}

/// Errors of a way to place points: (points per function, errors), by growing number.
type Curve = Vec<(f64, Errors)>;

/// What was measured of one basis.
struct Measured {
    states: usize,
    degree: u8,
    functions: usize,
    best: f64,
    many: Errors,
    halton: Curve,
    random: Vec<Curve>,
    grid: Curve,
}

impl Measured {
    fn of(states: usize, degree: u8) -> Result<Self> {
        let experiment = Experiment::new(states, degree)?;
        let functions = experiment.basis.len();
        let count = |share: f64| (share * functions as f64).ceil() as usize;
        let many = experiment.errors(&experiment.domain.halton((MANY.0 * functions).max(MANY.1))?)?;
        let mut found = Self {
            states,
            degree,
            functions,
            best: experiment.best()?,
            many,
            halton: Vec::new(),
            random: Vec::new(),
            grid: Vec::new(),
        };
        let shares = || SHARES.into_iter().filter(|share| functions <= LARGE || *share < 8.0);
        for share in shares() {
            found.halton.push((share, experiment.errors(&experiment.domain.halton(count(share))?)?));
        }
        for seed in SEEDS {
            let curve = shares()
                .map(|share| Ok((share, experiment.errors(&random(states, count(share), seed)?)?)))
                .collect::<Result<_>>()?;
            found.random.push(curve);
        }
        for side in 2.. {
            let share = (side as f64).powi(states as i32) / functions as f64;
            if share > LARGEST_GRID {
                break;
            }
            if share >= 1.0 {
                let points = experiment.domain.grid(&vec![side; states])?;
                found.grid.push((share, experiment.errors(&points)?));
            }
        }
        Ok(found)
    }

    /// The share of points from which on the errors stay within the factor; infinite where they never do.
    fn enough(&self, curves: &[Curve]) -> f64 {
        let of = |curve: &Curve| {
            let good = curve.iter().rev().take_while(|(_, errors)| errors.over(self.many) <= FACTOR);
            good.last().map_or(f64::INFINITY, |(share, _)| *share)
        };
        curves.iter().map(of).fold(0.0, f64::max)
    }

    /// Grids that determine the weights with fewer values of a state than the degree, or do not with as many: ∇V, which
    /// the equation sees, has a degree less.
    fn grids_that_surprise(&self) -> usize {
        let is_determined = |errors: &Errors| errors.law.is_finite();
        let expected = f64::from(self.degree).powi(self.states as i32) / self.functions as f64;
        self.grid.iter().filter(|(share, errors)| is_determined(errors) != (*share >= expected)).count()
    }

    fn row(&self) -> Vec<String> {
        let share = |curves: &[Curve]| {
            let enough = self.enough(curves);
            if enough.is_finite() { number(enough) } else { "more than 16".to_owned() }
        };
        vec![
            self.states.to_string(),
            self.degree.to_string(),
            self.functions.to_string(),
            number(self.best),
            number(self.many.value),
            number(self.many.law),
            share(std::slice::from_ref(&self.halton)),
            share(&self.random),
            share(std::slice::from_ref(&self.grid)),
            number(f64::from(self.degree).powi(self.states as i32) / self.functions as f64),
        ]
    }
}

/// The largest error over that of many points, of all bases, by points per function.
fn worst(all: &[&Measured], curves: impl Fn(&Measured) -> &[Curve]) -> Vec<[f64; 2]> {
    let at = |share: f64| {
        let of = |m: &Measured| -> f64 {
            let here = |curve: &Curve| curve.iter().find(|(s, _)| *s == share).map(|(_, e)| e.over(m.many));
            curves(m).iter().filter_map(here).fold(0.0, f64::max)
        };
        all.iter().map(|m| of(m)).fold(0.0, f64::max)
    };
    SHARES.iter().map(|share| [*share, at(*share)]).collect()
}

/// A linear plant, a chain, whose value function is the Riccati equation's and in the basis: the number of functions, and
/// the largest error of a weight over the largest weight at as many Halton points.
fn linear(states: usize) -> Result<(usize, f64)> {
    let a = DMatrix::from_fn(states, states, |i, j| match i.abs_diff(j) {
        0 => -0.5,
        1 if i < j => 1.0,
        1 => -1.0,
        _ => 0.0,
    });
    let b = DMatrix::from_fn(states, 1, |i, _| f64::from(u8::from(i + 1 == states)));
    let (q, r) = (DMatrix::identity(states, states), DMatrix::identity(1, 1));
    let basis = Monomials::even(states, 2)?;
    let riccati = lqr(&a, &b, &q, &r)?.solution;
    let exact = basis.quadratic(|i, j| riccati[(i, j)]);
    let count = basis.len();
    let points = Domain::symmetric(&vec![1.0; states])?.halton(count)?;
    let problem = Problem::new(&Linear { a, b }, &q, &r, basis, &points)?;
    // Without input the chain is stable: a start that is not the answer.
    let found = policy_iteration(&problem, &vec![0.0; count], PolicyOptions::default())?;
    let size = exact.iter().map(|w| w.abs()).fold(0.0, f64::max);
    let error = found.weights.iter().zip(&exact).map(|(w, e)| (w - e).abs()).fold(0.0, f64::max);
    Ok((count, error / size))
}

fn table(caption: &str, headings: &[&str], rows: Vec<Vec<String>>) -> Table {
    Table { caption: caption.into(), headings: headings.iter().map(|h| (*h).to_owned()).collect(), rows }
}

fn piece() -> Result<Piece> {
    let all: Vec<Measured> = CASES.iter().map(|(n, d)| Measured::of(*n, *d)).collect::<Result<_>>()?;
    let mut piece = Piece::new(
        Status::Reproduced,
        "The thesis's plant of section 4.3.3.2 in two to eight states over |xᵢ| ≤ 1, its value function known and \
         with cosines that no basis holds; all weights by policy iteration. Three Halton points per basis function give \
         the errors of any number of points within a factor of two, whatever the number of states: what grows with the \
         states is the basis. Random points do as well from four states on, and need up to eight with fewer. A grid \
         determines the weights from as many values of each state on as the degree, which is a number of points that is \
         exponential in the states.",
    );
    piece.tables.push(table(
        "Errors of V and u (RMS over RMS): of the best weights, and with many points; points per function from which \
         on both are within a factor of two of those with many points; points per function of the grid with as many \
         values of each state as the degree.",
        &HEADINGS,
        all.iter().map(Measured::row).collect(),
    ));
    let (mut rows, mut largest) = (Vec::new(), 0.0f64);
    for states in LINEAR {
        let (functions, error) = linear(states)?;
        largest = largest.max(error);
        rows.push(vec![states.to_string(), functions.to_string(), number(error)]);
    }
    piece
        .checks
        .push(Check::new("linear plants, one point per function: largest error of a weight", largest));
    piece.tables.push(table(
        "Linear plants, whose value function the basis holds: the largest error of a weight over the largest weight, with \
         one Halton point per function.",
        &["states", "functions", "error"],
        rows,
    ));
    judge(&mut piece, &all);
    draw_all(&mut piece, &all)?;
    Ok(piece)
}

fn judge(piece: &mut Piece, all: &[Measured]) {
    for m in all {
        let name = format!("{} states, degree {}", m.states, m.degree);
        piece.checks.push(Check::new(format!("{name}: error of V with many points"), m.many.value));
        piece.checks.push(Check::new(format!("{name}: error of u with many points"), m.many.law));
    }
    let from_four: Vec<&Measured> = all.iter().filter(|m| m.states >= 4).collect();
    let all: Vec<&Measured> = all.iter().collect();
    let halton = worst(&all, |m| std::slice::from_ref(&m.halton));
    let random = worst(&all, |m| &m.random);
    let random_from_four = worst(&from_four, |m| &m.random);
    for (name, curve, share) in [
        ("Halton", &halton, 1.25),
        ("Halton", &halton, 2.0),
        ("Halton", &halton, 3.0),
        ("random", &random, 3.0),
        ("random", &random, 8.0),
        ("random, four states and more", &random_from_four, 3.0),
    ] {
        let found = curve.iter().find(|p| p[0] == share).map_or(f64::NAN, |p| p[1]);
        let name = format!("{name}, {share} points per function: largest error over that of many points");
        piece.checks.push(Check::new(name, found));
    }
    let of_best = all.iter().map(|m| m.many.value / m.best).collect();
    let pairs = all.iter().flat_map(|m| {
        let richer = all.iter().find(|r| r.states == m.states && r.degree > m.degree);
        richer.map(|r| [m.many.value / r.many.value, m.many.law / r.many.law])
    });
    let of_richer = pairs.flatten().collect();
    for (name, ratios) in [
        ("error of V with many points over that of the best weights", of_best),
        ("errors of V and u at degree 4 over those at degree 6", of_richer),
    ] as [(&str, Vec<f64>); 2]
    {
        let least = ratios.iter().copied().fold(f64::INFINITY, f64::min);
        let largest = ratios.iter().copied().fold(0.0, f64::max);
        piece.checks.push(Check::new(format!("{name}, least"), least));
        piece.checks.push(Check::new(format!("{name}, largest"), largest));
    }
    let wrong = all.iter().map(|m| m.grids_that_surprise()).sum::<usize>();
    piece.checks.push(Check::new(
        "grids for which fewer values than the degree suffice, or as many do not",
        wrong as f64,
    ));
}

fn draw_all(piece: &mut Piece, all: &[Measured]) -> Result<()> {
    let of_degree = |degree: u8| all.iter().filter(move |m| m.degree == degree);
    for degree in [4, 6] {
        let mut series = Vec::new();
        for m in of_degree(degree) {
            let at = |curve: &Curve| -> Vec<[f64; 2]> {
                curve.iter().map(|(share, errors)| [share * m.functions as f64, errors.law]).collect()
            };
            let name = format!("{} states, {} functions", m.states, m.functions);
            series.push(Series::new(name, Style::Line, at(&m.halton)));
            if m.grid.iter().any(|(_, errors)| errors.law.is_finite()) {
                series.push(Series::new(format!("{} states, grid", m.states), Style::Dashed, at(&m.grid)));
            }
        }
        let caption =
            format!("Error of u against the number of points, degree {degree}: Halton points, and grids.");
        draw(piece, &caption, (Axis::log("points"), Axis::log("relative RMS error of u")), series)?;
    }
    let all: Vec<&Measured> = all.iter().collect();
    let series = vec![
        Series::new("random", Style::Line, worst(&all, |m| &m.random)),
        Series::new("Halton", Style::Line, worst(&all, |m| std::slice::from_ref(&m.halton))),
    ];
    draw(
        piece,
        "The largest error, of V or u and of all bases, over that of many points.",
        (Axis::log("points per basis function"), Axis::log("error over that of many points")),
        series,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_value_function_solves_its_equation() {
        for states in [2, 3, 8] {
            let plant = Known { states };
            let (mut f, mut g) = (vec![0.0; states], vec![0.0; states]);
            for x in random(states, 50, 7).unwrap() {
                plant.drift(&x, &mut f);
                plant.input(&x, &mut g);
                let v = Known::gradient(&x);
                let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
                let residual = dot(&v, &f) - 0.25 * dot(&v, &g).powi(2) + dot(&x, &x);
                assert!(residual.abs() < 1e-13, "{residual:e} at {x:?}");
                assert!((plant.control(&x) + 0.5 * dot(&v, &g)).abs() < 1e-15);
                // The gradient is that of the value.
                for i in 0..states {
                    let at = |h: f64| {
                        let mut y = x.clone();
                        y[i] += h;
                        Known::value(&y)
                    };
                    assert!((v[i] - (at(1e-6) - at(-1e-6)) / 2e-6).abs() < 1e-8);
                }
            }
        }
    }
}
