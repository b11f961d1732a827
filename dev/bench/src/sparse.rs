//! Rows of sparse regression, on the oscillator of thesis equation 2.18: 40 s at 1 kHz, exact states, noise of
//! 0.01 m/s² on the acceleration.

use std::ops::Range;

use anyhow::{Result, bail};
use greybox_simulate::rigs::{Duffing, Sampling};
use greybox_sparse::lasso::{LassoOptions, lasso_path};
use greybox_sparse::select::{Selector, logspace, search};
use greybox_sparse::stlsq::{Threshold, stlsq};
use greybox_sparse::{Function, Gram, Library, Options, Problem, Rows, Term, Triangle, folds::Split};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use serde_json::json;

use super::case::{Against, Answer, Case, Peer, Row, array, close};

/// Rows of the regression.
const ROWS: usize = 40_000;
/// Sample time, s.
const STEP: f64 = 1e-3;
/// λ tried, for unit columns and a unit target.
const LAMBDAS: usize = 50;
/// Bootstrap samples.
const REPLICATES: usize = 30;
/// Floating-point operations of a Gram matrix of 49 columns, every product counted, as a general matrix product does.
const GRAM_OPERATIONS: f64 = 2.0 * (ROWS * 49 * 49) as f64;

/// The rows.
pub(crate) fn rows() -> Vec<Row> {
    vec![
        Row::new(
            "gram",
            "Gram matrix of 40 000 × 49, library evaluated",
            "matrix",
            Against::Peak { operations: GRAM_OPERATIONS, goal: 0.6 },
            gram,
        ),
        Row::new(
            "gram_two_cores",
            "the same of two recordings",
            "pair",
            Against::TwoCores { goal: 1.7 },
            gram_pair,
        ),
        Row::new("lasso_path", "LASSO, 16 terms, 50 λ, from the triangle", "path", Against::NOTHING, path),
        Row::new(
            "algorithm1",
            "Algorithm 1: orders 1–6, 5 folds, 50 λ, 40 000 rows",
            "search",
            Against::Peers(&[Peer { function: "algorithm1", name: "scikit-learn LassoCV", goal: 100.0 }]),
            algorithm1,
        ),
        Row::new(
            "algorithm2",
            "Algorithm 2: 30 bootstraps × 50 λ, order 3",
            "search",
            Against::Peers(&[Peer { function: "algorithm2", name: "scikit-learn lasso_path", goal: 60.0 }]),
            algorithm2,
        ),
        Row::new(
            "stlsq",
            "one sparse fit, order 3, 40 000 rows",
            "fit",
            Against::Peers(&[Peer { function: "stlsq", name: "PySINDy STLSQ", goal: 15.0 }]),
            one_fit,
        ),
    ]
}

/// Position, velocity, force and acceleration, the last with noise.
pub(crate) struct Record {
    pub(crate) x: Vec<f64>,
    pub(crate) v: Vec<f64>,
    pub(crate) force: Vec<f64>,
    pub(crate) acceleration: Vec<f64>,
}

impl Record {
    /// The same for the same seed.
    pub(crate) fn new(seed: u64) -> Result<Self> {
        let rig = Duffing::THESIS;
        let states = rig.run(Sampling { dt: STEP, substeps: 2 }, [1.0, 0.0], ROWS, Duffing::thesis_force)?;
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let noise = Normal::new(0.0, 0.01)?;
        let force: Vec<f64> = (0..ROWS).map(|k| Duffing::thesis_force(k as f64 * STEP)).collect();
        let acceleration = states.iter().zip(&force).map(|([x, v], f)| {
            let inside = x * (rig.k1 + rig.k3 * x * x) + v * (rig.c1 + rig.c2 * x * x + rig.c3 * v * v);
            (f - inside) / rig.m + noise.sample(&mut random)
        });
        let acceleration = acceleration.collect();
        let (x, v) = states.iter().map(|[x, v]| (*x, *v)).unzip();
        Ok(Self { x, v, force, acceleration })
    }

    /// The force, 1 and the products of powers up to `order`; with the number of columns of every order.
    fn columns(&self, order: u32) -> Result<(Vec<Vec<f64>>, Vec<usize>)> {
        let library = library(order);
        let mut columns = vec![self.force.clone()];
        columns.extend(library.evaluate(&[&self.x, &self.v], &[])?);
        Ok((columns, library.lengths().iter().map(|l| l + 1).collect()))
    }
}

/// 1 and the products of powers up to `order`: (order + 1)² terms.
fn library(order: u32) -> Library {
    Library::tensor(&["x", "x'"], &[order, order]).with_in_every_order(Term::powers(&[0, 0]))
}

fn all() -> Vec<Range<usize>> {
    std::iter::once(0..ROWS).collect()
}

fn gram_of(record: &Record, library: &Library) -> Result<Gram> {
    Ok(Gram::of_library(library, &[&record.x, &record.v], &[], &record.acceleration, &all())?)
}

fn gram() -> Result<Case> {
    let (record, library) = (Record::new(1)?, library(6));
    Ok(Case::alone(1.0, move || {
        let gram = gram_of(&record, &library)?;
        Ok(Answer::from([("moments".to_owned(), (0..49).map(|i| gram.moment(i)).collect())]))
    }))
}

fn gram_pair() -> Result<Case> {
    let (records, library) = ([Record::new(1)?, Record::new(2)?], library(6));
    Ok(Case::alone(1.0, move || {
        let (a, b) = rayon::join(|| gram_of(&records[0], &library), || gram_of(&records[1], &library));
        Ok(Answer::from([("moments".to_owned(), vec![a?.moment(0), b?.moment(0)])]))
    }))
}

fn lambdas() -> Vec<f64> {
    logspace(1e-3, 1.0, LAMBDAS)
}

fn path() -> Result<Case> {
    let record = Record::new(1)?;
    let (columns, _) = record.columns(3)?;
    let triangle = Triangle::of_rows(&Rows::from_vecs(&columns, &record.acceleration)?, &all())?;
    let weights = vec![1.0; columns.len()];
    Ok(Case::alone(1.0, move || {
        let path = lasso_path(&triangle, &weights, &lambdas(), &LassoOptions::default())?;
        Ok(Answer::from([("sweeps".to_owned(), path.iter().map(|f| f.sweeps as f64).collect())]))
    }))
}

fn algorithm1() -> Result<Case> {
    let record = Record::new(1)?;
    let (columns, orders) = record.columns(6)?;
    let mut options = Options::raw();
    (options.selector, options.grid, options.folds) = (Selector::Lasso, lambdas(), 5);
    let settings =
        json!({"columns": columns.len(), "orders": orders, "lambdas": options.grid, "folds": options.folds});
    let data = vec![("columns", columns.concat()), ("target", record.acceleration.clone())];
    let judge = Judge::new(&columns, &record.acceleration, &orders)?;
    let work = move || {
        // The peer's criterion is that of the rows it was fitted to, so ours is here.
        let split = Split { train: all(), test: all() };
        let problem = Problem::new(Rows::from_vecs(&columns, &record.acceleration)?, &orders, &[], split)?;
        let found = search(&problem, &options)?;
        let mut answer = Answer::new();
        let mut push = |name: &str, values: &[f64]| {
            answer.entry(name.to_owned()).or_default().extend_from_slice(values);
        };
        for model in &found.orders {
            push("lambdas", &[model.lambda()]);
            push("coefficients", &model.coefficients[..model.candidates]);
            push("curves", &model.cv_mean);
            push("aic", &[model.aic]);
        }
        Ok(answer)
    };
    let agree = move |_: &str, ours: &Answer, theirs: &Answer| judge.compare(ours, theirs);
    Ok(Case { data, settings, work: Box::new(work), units: 1.0, agree: Box::new(agree) })
}

/// scikit-learn stops at a duality gap of 1e-4 ‖y‖².
const PEERS_GAP: f64 = 1e-4;

/// Compares two searches by the LASSO's objective, of which both minimise the same.
struct Judge {
    triangles: Vec<Triangle>,
    norms: Vec<f64>,
    size: f64,
}

impl Judge {
    fn new(columns: &[Vec<f64>], target: &[f64], orders: &[usize]) -> Result<Self> {
        let rows: Vec<Range<usize>> = std::iter::once(0..target.len()).collect();
        let whole = Triangle::of_rows(&Rows::from_vecs(columns, target)?, &rows)?;
        let norms = (0..columns.len()).map(|j| whole.norm(j)).collect();
        let triangles = orders.iter().map(|&count| whole.first_columns(count)).collect();
        Ok(Self { triangles, norms, size: whole.target_norm() })
    }

    /// ½ ‖ŷ − X̂ β‖² + λ ‖β‖₁ for coefficients of the columns as they are.
    fn objective(&self, triangle: &Triangle, coefficients: &[f64], lambda: f64) -> f64 {
        let sum: f64 = coefficients.iter().zip(&self.norms).map(|(c, n)| (c * n / self.size).abs()).sum();
        0.5 * triangle.rss(coefficients) / (self.size * self.size) + lambda * sum
    }

    fn compare(&self, ours: &Answer, theirs: &Answer) -> Result<String> {
        let (mut at, mut worst) = (0, 0.0_f64);
        for (triangle, &lambda) in self.triangles.iter().zip(array(theirs, "lambdas")?) {
            let count = triangle.columns();
            let scaled = &array(theirs, "coefficients")?[at..at + count];
            at += count;
            let peers: Vec<f64> =
                scaled.iter().zip(&self.norms).map(|(beta, norm)| beta * self.size / norm).collect();
            let own = lasso_path(triangle, &vec![1.0; count], &[lambda], &LassoOptions::default())?;
            let own = own.first().map_or(f64::NAN, |f| self.objective(triangle, &f.fit.coefficients, lambda));
            let excess = self.objective(triangle, &peers, lambda) - own;
            worst = worst.max(excess);
            if excess.is_nan() || !(-1e-9..=PEERS_GAP).contains(&excess) {
                bail!(
                    "{count} columns, λ = {lambda:.3e}: the peer's objective exceeds ours by {excess:.1e} ‖y‖²"
                );
            }
        }
        // What two points within the gap may differ by in their predictions, twice: held-out rows are others.
        let allowed = 2.0 * (2.0 * PEERS_GAP).sqrt();
        let size = self.size / (ROWS as f64).sqrt();
        let curves = array(ours, "curves")?.iter().zip(array(theirs, "curves")?);
        let apart = curves.map(|(a, b)| (a.sqrt() - b.sqrt()).abs() / size).fold(0.0, f64::max);
        if apart > allowed || array(ours, "curves")?.len() != array(theirs, "curves")?.len() {
            bail!(
                "the errors of cross-validation differ by {apart:.1e} of the target; {allowed:.1e} is allowed"
            );
        }
        Ok(format!(
            "the peer's objective is above ours by at most {worst:.0e} ‖y‖² (its tolerance {PEERS_GAP:.0e}), errors of \
             cross-validation within {apart:.0e} of the target (allowed {allowed:.0e})"
        ))
    }
}

fn algorithm2() -> Result<Case> {
    let record = Record::new(1)?;
    let (columns, _) = record.columns(3)?;
    let mut random = Pcg64Mcg::seed_from_u64(2);
    // Thesis Algorithm 2: half as many rows as there are, with replacement.
    let draws: Vec<Vec<usize>> =
        (0..REPLICATES).map(|_| (0..ROWS / 2).map(|_| random.random_range(0..ROWS)).collect()).collect();
    let flat: Vec<f64> = draws.iter().flatten().map(|&i| i as f64).collect();
    let settings = json!({"columns": columns.len(), "replicates": REPLICATES, "lambdas": lambdas()});
    let data = vec![("columns", columns.concat()), ("target", record.acceleration.clone()), ("draws", flat)];
    let judges: Vec<Judge> = draws
        .iter()
        .map(|draw| {
            let drawn = |from: &[f64]| draw.iter().map(|&i| from[i]).collect::<Vec<f64>>();
            let parts: Vec<Vec<f64>> = columns.iter().map(|c| drawn(c)).collect();
            Judge::new(&parts, &drawn(&record.acceleration), &[columns.len()])
        })
        .collect::<Result<_>>()?;
    let weights = vec![1.0; columns.len()];
    let work = move || {
        let rows = Rows::from_vecs(&columns, &record.acceleration)?;
        let mut found = Vec::new();
        let taken: Vec<Vec<u32>> = draws
            .iter()
            .map(|draw| {
                let mut taken = vec![0; ROWS];
                draw.iter().for_each(|&i| taken[i] += 1);
                taken
            })
            .collect();
        let samples: Vec<&[u32]> = taken.iter().map(Vec::as_slice).collect();
        for gram in Gram::of_samples(&rows, &samples)? {
            let triangle = Triangle::of_gram(&gram)?;
            for fit in lasso_path(&triangle, &weights, &lambdas(), &LassoOptions::default())? {
                found.extend(fit.fit.coefficients);
            }
        }
        Ok(Answer::from([("coefficients".to_owned(), found)]))
    };
    let agree = move |_: &str, ours: &Answer, theirs: &Answer| {
        let (ours, theirs) = (array(ours, "coefficients")?, array(theirs, "coefficients")?);
        let (mut at, mut worst) = (0, 0.0_f64);
        for (replicate, judge) in judges.iter().enumerate() {
            for lambda in lambdas() {
                let triangle = &judge.triangles[0];
                let range = at..at + triangle.columns();
                at = range.end;
                let (Some(ours), Some(theirs)) = (ours.get(range.clone()), theirs.get(range)) else {
                    bail!("{} coefficients against {}", ours.len(), theirs.len());
                };
                let excess =
                    judge.objective(triangle, theirs, lambda) - judge.objective(triangle, ours, lambda);
                worst = worst.max(excess);
                if excess.is_nan() || !(-1e-9..=PEERS_GAP).contains(&excess) {
                    bail!(
                        "bootstrap {replicate}, λ = {lambda:.3e}: the peer exceeds our objective by {excess:.1e} ‖y‖²"
                    );
                }
            }
        }
        Ok(format!(
            "the peer's objective is above ours by at most {worst:.0e} ‖y‖² in {} fits (its tolerance {PEERS_GAP:.0e})",
            REPLICATES * LAMBDAS
        ))
    };
    Ok(Case { data, settings, work: Box::new(work), units: 1.0, agree: Box::new(agree) })
}

fn one_fit() -> Result<Case> {
    const THRESHOLD: f64 = 0.02;
    let record = Record::new(1)?;
    let library = library(3);
    let powers: Vec<[u32; 2]> = library.terms().iter().map(|t| [t.power(0), t.power(1)]).collect();
    let force = Term::function(Function::Expression("f".to_owned()));
    let forced = library.with_in_every_order(force);
    let settings = json!({"powers": powers, "threshold": THRESHOLD});
    let data = vec![
        ("x", record.x.clone()),
        ("v", record.v.clone()),
        ("force", record.force.clone()),
        ("target", record.acceleration.clone()),
    ];
    let work = move || {
        let force = [("f", &record.force[..])];
        let variables = [&record.x[..], &record.v];
        let gram = Gram::of_library(&forced, &variables, &force, &record.acceleration, &all())?;
        let triangle = Triangle::of_gram(&gram)?;
        let fit = stlsq(&triangle, &[], THRESHOLD, Threshold::Raw)?;
        Ok(Answer::from([("coefficients".to_owned(), fit.coefficients)]))
    };
    let agree = |_: &str, ours: &Answer, theirs: &Answer| {
        let support = |a: &Answer| -> Result<Vec<bool>> {
            Ok(array(a, "coefficients")?.iter().map(|c| *c != 0.0).collect())
        };
        if support(ours)? != support(theirs)? {
            bail!("the terms chosen differ");
        }
        Ok(format!("same terms, {}", close(ours, theirs, "coefficients", 1e-6)?))
    };
    Ok(Case { data, settings, work: Box::new(work), units: 1.0, agree: Box::new(agree) })
}
