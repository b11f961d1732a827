//! Extended-state observers, one for each measured coordinate.

use greybox_eso::{Design, EsoError, Fal, Observer as Chain, Scheme};
use greybox_hjb::Linear;
use nalgebra::DMatrix;

use super::tangent::Tangent;
use crate::equilibrium::Equilibrium;
use crate::error::ControlError;
use crate::plant::Plant;

/// The observers of all coordinates; together they have every state.
#[derive(Debug, Clone)]
pub(super) struct Chains {
    coordinates: Vec<Coordinate>,
}

/// A measured coordinate with its chain of derivatives.
#[derive(Debug, Clone)]
struct Coordinate {
    /// Index of the first of its states; the others follow.
    first: usize,
    /// Number of its states.
    order: usize,
    /// Gain of the command in the highest derivative, at the design point.
    input: f64,
    chain: AnyChain,
}

/// Observers of the orders that occur.
#[derive(Debug, Clone)]
pub(super) enum AnyChain {
    Two(Chain<2>),
    Three(Chain<3>),
    Four(Chain<4>),
}

impl AnyChain {
    fn new(order: usize, bandwidth: f64, dt: f64, input: f64) -> Result<Option<AnyChain>, EsoError> {
        fn chain<const N: usize>(bandwidth: f64, dt: f64, input: f64) -> Result<Chain<N>, EsoError> {
            let design = Design::from_bandwidth(bandwidth, [Fal::LINEAR; N])?;
            Chain::new(design, dt, Scheme::Trapezoidal)?.with_extended_state(input)
        }
        Ok(match order {
            1 => Some(AnyChain::Two(chain(bandwidth, dt, input)?)),
            2 => Some(AnyChain::Three(chain(bandwidth, dt, input)?)),
            3 => Some(AnyChain::Four(chain(bandwidth, dt, input)?)),
            _ => None,
        })
    }

    fn update(&mut self, y: f64, u: f64) -> Vec<f64> {
        match self {
            AnyChain::Two(chain) => chain.update(y, u).to_vec(),
            AnyChain::Three(chain) => chain.update(y, u).to_vec(),
            AnyChain::Four(chain) => chain.update(y, u).to_vec(),
        }
    }

    fn start_at(&mut self, z: &[f64], y: f64) {
        fn start<const N: usize>(chain: &mut Chain<N>, z: &[f64], y: f64) {
            chain.start_at(std::array::from_fn(|i| z.get(i).copied().unwrap_or(0.0)), y);
        }
        match self {
            AnyChain::Two(chain) => start(chain, z, y),
            AnyChain::Three(chain) => start(chain, z, y),
            AnyChain::Four(chain) => start(chain, z, y),
        }
    }
}

/// One step of an extended-state observer in matrices, (z⁺ = A z + b₀ y + b₁ y⁺ + g u).
#[derive(Debug, Clone, PartialEq)]
pub struct EsoStep {
    /// Index of the coordinate's first state.
    pub first: usize,
    /// A, row by row; its size is the coordinate's order and one.
    pub a: Vec<Vec<f64>>,
    /// b₀, of the measurement of the last sample.
    pub before: Vec<f64>,
    /// b₁, of the measurement now.
    pub now: Vec<f64>,
    /// g, of the command since the last sample.
    pub input: Vec<f64>,
    /// b, the command's gain in the coordinate's highest derivative.
    pub gain: f64,
    /// Weight of this coordinate in d̂: one over the square of the size of its last state.
    pub weight: f64,
}

impl Chains {
    /// A chain for each measured coordinate; together they must have every state.
    pub(super) fn design(
        plant: &Plant,
        at: &Equilibrium,
        dt: f64,
        bandwidth: f64,
        measured: &[usize],
    ) -> Result<Chains, ControlError> {
        let symbols = plant.symbols();
        let tangent = plant.frictionless_tangent(&at.state, at.input);
        let mut coordinates = Vec::new();
        for (first, (name, primes)) in symbols.iter().enumerate() {
            if *primes > 0 {
                continue;
            }
            let order = symbols.iter().filter(|(n, _)| n == name).count();
            let is_chain = symbols[first..]
                .iter()
                .take(order)
                .enumerate()
                .all(|(k, (n, p))| n == name && usize::from(*p) == k);
            if !(measured.contains(&first) && is_chain) {
                return Err(ControlError::EsoUnmeasured { name: name.clone() });
            }
            let input = tangent.b[first + order - 1];
            let chain = AnyChain::new(order, bandwidth, dt, input)
                .map_err(|source| ControlError::Eso { source })?
                .ok_or_else(|| ControlError::EsoOrder { name: name.clone(), order })?;
            coordinates.push(Coordinate { first, order, input, chain });
        }
        Ok(Chains { coordinates })
    }

    /// The chains before the first sample.
    pub(super) fn start(&self) -> Vec<AnyChain> {
        self.coordinates.iter().map(|c| c.chain.clone()).collect()
    }

    /// One step of each chain in matrices.
    pub(super) fn steps(&self, plant: &Plant) -> Vec<EsoStep> {
        self.coordinates.iter().map(|c| c.step(plant)).collect()
    }

    /// x̂ from the chains, and d̂ by least squares over what f does not explain of their lumped disturbances.
    pub(super) fn follow(
        &self,
        plant: &Plant,
        measured: &[usize],
        (estimate, chains): (&mut [f64], &mut [AnyChain]),
        y: &[f64],
        u: f64,
    ) {
        let n = plant.order();
        let mut lumped = Vec::with_capacity(self.coordinates.len());
        for (coordinate, chain) in self.coordinates.iter().zip(chains) {
            let at = measured.iter().position(|i| *i == coordinate.first);
            let y = at.and_then(|at| y.get(at)).copied().unwrap_or(f64::NAN);
            let z = chain.update(y, u);
            estimate[coordinate.first..][..coordinate.order].copy_from_slice(&z[..coordinate.order]);
            lumped.push(z[coordinate.order] + coordinate.input * u);
        }
        estimate[n] = self.disturbance(plant, &estimate[..n], &lumped, u);
    }

    /// The chains, x̂ and d̂ at a machine that rests at its measurements under a command: z = (y, 0, …, −b u).
    pub(super) fn rest(
        &self,
        plant: &Plant,
        measured: &[usize],
        (estimate, chains): (&mut [f64], &mut [AnyChain]),
        y: &[f64],
        u: f64,
    ) {
        let n = plant.order();
        for (coordinate, chain) in self.coordinates.iter().zip(chains) {
            let at = measured.iter().position(|i| *i == coordinate.first);
            let y = at.and_then(|at| y.get(at)).copied().unwrap_or(f64::NAN);
            let mut z = vec![0.0; coordinate.order + 1];
            z[0] = y;
            z[coordinate.order] = -coordinate.input * u;
            chain.start_at(&z, y);
            estimate[coordinate.first..][..coordinate.order].copy_from_slice(&z[..coordinate.order]);
        }
        let lumped = vec![0.0; self.coordinates.len()];
        estimate[n] = self.disturbance(plant, &estimate[..n], &lumped, u);
    }

    /// d̂ from what the highest derivatives are, the command included.
    fn disturbance(&self, plant: &Plant, x: &[f64], lumped: &[f64], u: f64) -> f64 {
        let modelled = plant.frictionless_rate(x, u);
        let mut g = vec![0.0; x.len()];
        plant.frictionless_input(x, &mut g);
        let (mut above, mut below) = (0.0, 0.0);
        for (coordinate, lumped) in self.coordinates.iter().zip(lumped) {
            let row = coordinate.first + coordinate.order - 1;
            let weight = g[row] / (plant.sizes()[row] * plant.sizes()[row]);
            above += weight * (lumped - modelled[row]);
            below += weight * g[row];
        }
        if below > 0.0 { above / below } else { 0.0 }
    }

    /// The tangent at a state of rest of the plant; the older of two commands acts for a share of a sample.
    pub(super) fn tangent(
        &self,
        plant: &Plant,
        tangent_of: &Linear,
        measured: &[usize],
        share_older: f64,
    ) -> Tangent {
        let (n, m) = (plant.order(), measured.len());
        // c: the chains one after the other, the last measurements, the last command.
        let steps: Vec<EsoStep> = self.coordinates.iter().map(|c| c.step(plant)).collect();
        let chains: usize = steps.iter().map(|s| s.a.len()).sum();
        let size = chains + m + 1;
        let mut tangent = Tangent {
            carry: DMatrix::zeros(size, size),
            older: DMatrix::zeros(size, 1),
            newer: DMatrix::zeros(size, 1),
            measured: DMatrix::zeros(size, m),
            estimate: DMatrix::zeros(n + 1, size),
        };
        let below: f64 = self.coordinates.iter().map(|c| c.weight(plant, &tangent_of.b)).sum();
        let mut first = 0;
        for (coordinate, step) in self.coordinates.iter().zip(&steps) {
            let at = measured.iter().position(|i| *i == step.first).unwrap_or(0);
            let order = coordinate.order;
            for i in 0..=order {
                for j in 0..=order {
                    tangent.carry[(first + i, first + j)] = step.a[i][j];
                }
                tangent.carry[(first + i, chains + at)] = step.before[i];
                tangent.measured[(first + i, at)] = step.now[i];
                tangent.older[(first + i, 0)] = share_older * step.input[i];
                tangent.newer[(first + i, 0)] = (1.0 - share_older) * step.input[i];
            }
            for i in 0..order {
                tangent.estimate[(step.first + i, first + i)] = 1.0;
            }
            let row = step.first + order - 1;
            let share = coordinate.weight(plant, &tangent_of.b) / (tangent_of.b[row] * below);
            if below > 0.0 && tangent_of.b[row] != 0.0 {
                tangent.estimate[(n, first + order)] += share;
                tangent.estimate[(n, size - 1)] += share * (coordinate.input - tangent_of.b[row]);
            }
            first += order + 1;
        }
        // What f explains, once the states stand in their rows.
        for coordinate in &self.coordinates {
            let row = coordinate.first + coordinate.order - 1;
            if below > 0.0 && tangent_of.b[row] != 0.0 {
                let share = coordinate.weight(plant, &tangent_of.b) / (tangent_of.b[row] * below);
                for c in 0..size {
                    let explained: f64 =
                        (0..n).map(|j| tangent_of.a[(row, j)] * tangent.estimate[(j, c)]).sum();
                    tangent.estimate[(n, c)] -= share * explained;
                }
            }
        }
        for i in 0..m {
            tangent.measured[(chains + i, i)] = 1.0;
        }
        tangent.older[(size - 1, 0)] = share_older;
        tangent.newer[(size - 1, 0)] = 1.0 - share_older;
        tangent
    }
}

impl Coordinate {
    /// (g / size)².
    fn weight(&self, plant: &Plant, g: &DMatrix<f64>) -> f64 {
        let row = self.first + self.order - 1;
        (g[row] / plant.sizes()[row]).powi(2)
    }

    /// The matrices of a step, by unit answers of the observer, which is linear.
    fn step(&self, plant: &Plant) -> EsoStep {
        let n = self.order + 1;
        let answer = |z: &[f64], before: f64, now: f64, u: f64| {
            let mut chain = self.chain.clone();
            chain.start_at(z, before);
            chain.update(now, u)
        };
        let unit = |j: usize| -> Vec<f64> { (0..n).map(|i| f64::from(u8::from(i == j))).collect() };
        let zero = vec![0.0; n];
        let columns: Vec<Vec<f64>> = (0..n).map(|j| answer(&unit(j), 0.0, 0.0, 0.0)).collect();
        EsoStep {
            first: self.first,
            a: (0..n).map(|i| columns.iter().map(|c| c[i]).collect()).collect(),
            before: answer(&zero, 1.0, 0.0, 0.0),
            now: answer(&zero, 0.0, 1.0, 0.0),
            input: answer(&zero, 0.0, 0.0, 1.0),
            gain: self.input,
            weight: plant.sizes()[self.first + self.order - 1].powi(-2),
        }
    }
}
