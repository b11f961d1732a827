//! Rows of optimal control, observers and control laws.

use std::hint::black_box;

use anyhow::Result;
use greybox_eso::{Design, Observer, Scheme};
use greybox_hjb::{AdamaxOptions, adamax, lqr};
use greybox_smc::thesis::LinkTangent;
use greybox_smc::{BoundaryLayer, FlatOutput, Law, Rate, Surface, Target};
use nalgebra::{DMatrix, dmatrix};
use serde_json::{Value, json};

use super::case::{Against, Answer, Case, Peer, Row, close};
use greybox_reproduce::F16;

/// Steps of a call: the clock is coarse beside one of them.
const STEPS: usize = 20_000;

/// The rows.
pub(crate) fn rows() -> Vec<Row> {
    vec![
        Row::new(
            "adamax",
            "Algorithm 3 on the F16's grid of 500 points",
            "iteration",
            Against::Peers(&[Peer { function: "adamax", name: "NumPy, vectorised", goal: 10.0 }]),
            training,
        ),
        Row::new(
            "riccati",
            "linear-quadratic regulator of the F16",
            "design",
            Against::Peers(&[
                Peer { function: "riccati_scipy", name: "SciPy solve_continuous_are", goal: 10.0 },
                Peer { function: "riccati_slycot", name: "python-control lqr on SLICOT", goal: 1.5 },
            ]),
            regulator,
        ),
        Row::new("observer", "state observer of the thesis, 2 states", "sample", Against::NOTHING, observer),
        Row::new(
            "control_law",
            "sliding-mode law of the flexible link, 4 states",
            "step",
            Against::NOTHING,
            law,
        ),
    ]
}

fn training() -> Result<Case> {
    const ITERATIONS: usize = 6000;
    let F16 { problem, points, .. } = F16::new()?;
    let options = AdamaxOptions { iterations: ITERATIONS, patience: None, ..AdamaxOptions::default() };
    let work = move || {
        let trained = adamax(&problem, &[1.0; 6], &options)?;
        Ok(Answer::from([("weights".to_owned(), trained.weights)]))
    };
    Ok(Case {
        data: vec![("points", points.concat())],
        settings: json!({"iterations": ITERATIONS}),
        work: Box::new(work),
        units: ITERATIONS as f64,
        agree: Box::new(|_, ours, theirs| {
            // Ours are the best weights met, the peer's the last; a constant step keeps both in motion.
            close(ours, theirs, "weights", 1e-3)
        }),
    })
}

fn regulator() -> Result<Case> {
    let (plant, q, r) = (F16::plant(), DMatrix::identity(3, 3), dmatrix![1.0]);
    let work = move || {
        let found = lqr(&plant.a, &plant.b, &q, &r)?;
        Ok(Answer::from([("solution".to_owned(), found.solution.as_slice().to_vec())]))
    };
    Ok(Case {
        data: vec![],
        settings: Value::Null,
        work: Box::new(work),
        units: 1.0,
        agree: Box::new(|_, ours, theirs| close(ours, theirs, "solution", 1e-12)),
    })
}

fn observer() -> Result<Case> {
    let mut observer = Observer::new(Design::thesis(), 1e-3, Scheme::Euler)?;
    Ok(Case::alone(STEPS as f64, move || {
        let mut z = [0.0; 2];
        for k in 0..STEPS {
            z = observer.update((1e-3 * k as f64).fract(), 0.0);
        }
        Ok(Answer::from([("state".to_owned(), z.to_vec())]))
    }))
}

fn law() -> Result<Case> {
    let link = LinkTangent::IDENTIFIED.tangent();
    let law = Law::new(
        FlatOutput::new(&link)?,
        Surface::repeated(16.0)?,
        BoundaryLayer::new(590.0, 5.9)?,
        10.0,
        Rate::Model,
    )?;
    let target = Target::rest([0.1; 4]);
    Ok(Case::alone(STEPS as f64, move || {
        let mut x = [0.0; 4];
        for _ in 0..STEPS {
            // The next state depends on the command, so that steps do not overlap; what stays the same is hidden from
            // the compiler, which would compute it once for all steps if it inlined the law.
            let (law, f, g) = (black_box(&law), black_box(&[0.3; 4]), black_box(&link.b));
            x[0] = 1e-3 * law.step(&x, f, g, &target)?.u;
        }
        Ok(Answer::from([("state".to_owned(), x.to_vec())]))
    }))
}
