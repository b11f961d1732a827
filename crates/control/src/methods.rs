//! The laws, in symbols.

use greybox_hjb::{Domain, InputRange, Linear, Monomials, Verification};
use greybox_model::{Expr, Func};
use greybox_smc::{BoundaryLayer, Rate, SmcError, Surface, Tangent};
use nalgebra::{DMatrix, dmatrix};

use crate::equilibrium::Equilibrium;
use crate::error::ControlError;
use crate::feedforward::{FeedForward, Target};
use crate::plant::Plant;
use crate::specification::Weights;

/// Relative size of the even part of a drift below which it counts as odd.
const ODD: f64 = 1e-9;

/// The share of the input's range that a set point must leave to either limit of a bounded law.
const ROOM: f64 = 1e-6;

/// What every method starts from.
pub(crate) struct Design<'a> {
    pub(crate) plant: &'a Plant,
    /// At the design point, friction dropped.
    pub(crate) tangent: Linear,
    pub(crate) at: &'a Equilibrium,
    pub(crate) set_point: f64,
    pub(crate) dt: f64,
    pub(crate) weights: &'a Weights,
    pub(crate) feed_forward: &'a FeedForward,
    /// Name of the tracked state.
    pub(crate) tracked: &'a str,
    pub(crate) limits: (f64, f64),
    /// x_d and u_d: x_e(r) and u_e(r), with what r′ and r″ add.
    pub(crate) target: &'a Target,
}

/// A law without limits.
pub(crate) struct Made {
    pub(crate) law: Expr,
    /// The same without its compensation of friction.
    pub(crate) frictionless: Expr,
    pub(crate) verification: Option<Verification>,
}

/// Σ cᵢ eᵢ.
fn sum(terms: impl IntoIterator<Item = (f64, Expr)>) -> Expr {
    let all = terms.into_iter().filter(|(c, _)| *c != 0.0);
    all.fold(Expr::Num(0.0), |sum, (c, e)| sum + Expr::Num(c) * e).simplify()
}

impl Design<'_> {
    fn state(&self, i: usize) -> Expr {
        let (name, primes) = &self.plant.symbols()[i];
        Expr::prime(name, *primes)
    }

    fn hint(&self) -> &'static str {
        if self.plant.open_gaps {
            "; within a dead zone nothing pulls: design as if it were closed (`close_gaps`)"
        } else {
            ""
        }
    }

    /// xᵢ − x_dᵢ.
    fn deviation(&self, i: usize) -> Expr {
        (self.state(i) - self.target.state[i].clone()).simplify()
    }

    /// u = u_d − K (x − x_d), K constant or a function of r.
    pub(crate) fn lqr(&self, scheduled: bool) -> Result<Made, ControlError> {
        let (n, sizes) = (self.plant.order(), self.plant.sizes());
        let gains: Vec<Expr> = if scheduled {
            let (low, high) = self.feed_forward.range;
            let points = &self.feed_forward.equilibria;
            let all = points.iter().enumerate().map(|(k, at)| {
                let share = k as f64 / (points.len() - 1).max(1) as f64;
                let tangent = self.plant.frictionless_tangent(&at.state, at.input);
                self.regulator(&tangent, low + (high - low) * share)
            });
            let all = all.collect::<Result<Vec<_>, _>>()?;
            let gain = |i: usize| all.iter().map(|k| k[i]).collect::<Vec<f64>>();
            // A gain is counted in input's size per state's size.
            let size = |i: usize| self.plant.input_size() / sizes[i];
            (0..n).map(|i| self.feed_forward.curve(&gain(i), size(i)).0).collect()
        } else {
            self.regulator(&self.tangent, self.set_point)?.into_iter().map(Expr::Num).collect()
        };
        let parts =
            gains.into_iter().enumerate().map(|(i, gain)| (1.0, (gain * self.deviation(i)).simplify()));
        let law = (self.target.input.clone() - sum(parts)).simplify();
        Ok(Made { frictionless: law.clone(), law, verification: None })
    }

    /// K, computed in states and input counted in their sizes.
    fn regulator(&self, tangent: &Linear, set_point: f64) -> Result<Vec<f64>, ControlError> {
        let (n, sizes, unit) = (self.plant.order(), self.plant.sizes(), self.plant.input_size());
        let Linear { a, b } = tangent;
        let a = DMatrix::from_fn(n, n, |i, j| a[(i, j)] / sizes[i] * sizes[j]);
        let b = DMatrix::from_fn(n, 1, |i, _| b[i] / sizes[i] * unit);
        let (q, r) = self.cost(sizes, unit);
        let wrap = |source| ControlError::Linear { set_point, source, hint: self.hint() };
        let regulator = greybox_hjb::lqr(&a, &b, &q, &r).map_err(wrap)?;
        Ok((0..n).map(|i| regulator.gain[(0, i)] * unit / sizes[i]).collect())
    }

    /// Q and R for states and input counted in sizes.
    fn cost(&self, sizes: &[f64], unit: f64) -> (DMatrix<f64>, DMatrix<f64>) {
        let n = sizes.len();
        let weight = |i: usize| self.weights.states[i] * sizes[i] * sizes[i];
        let q = DMatrix::from_fn(n, n, |i, j| if i == j { weight(i) } else { 0.0 });
        (q, dmatrix![self.weights.input * unit * unit])
    }

    /// u = u_d − ½ R⁻¹ Σ gᵢ(x) ∂V/∂xᵢ, V a polynomial of the deviations counted in half widths of the domain; or
    /// `bounded`.
    pub(crate) fn hjb(&self, degree: u8, domain: &[f64], bounded: bool) -> Result<Made, ControlError> {
        let n = self.plant.order();
        let widths = self.half_widths(domain)?;
        let unit = self.plant.input_size();
        let shifted = Shifted { plant: self.plant, at: self.at, widths: &widths, unit };
        let (q, r) = self.cost(&widths, unit);
        let wrap = |source| ControlError::Hjb { set_point: self.set_point, source, hint: self.hint() };
        let box_ = Domain::symmetric(&vec![1.0; n]).map_err(wrap)?;
        let limits = bounded.then(|| self.limits_behind_dead_zone()).transpose()?;
        let range = match limits {
            Some((low, high)) => {
                InputRange::new((low - self.at.input) / unit, (high - self.at.input) / unit).map_err(wrap)?
            }
            None => InputRange::UNLIMITED,
        };
        let even_cost = !range.is_limited() || (range.low() + range.high()).abs() <= ODD * range.high();
        let odd_terms = degree % 2 == 1 || !even_cost || !shifted.is_odd(&box_.halton(40).map_err(wrap)?);
        let basis = if odd_terms { Monomials::full(n, degree) } else { Monomials::even(n, degree) };
        let basis = basis.map_err(wrap)?;
        let optimal = greybox_hjb::design_within(&shifted, &q, &r, &[range], &box_, &basis).map_err(wrap)?;
        let scaled: Vec<Expr> = (0..n).map(|i| self.deviation(i) / Expr::Num(widths[i])).collect();
        let basis = optimal.feedback.basis();
        let gradient = |i: usize| {
            sum(basis.exponents().zip(optimal.feedback.weights()).filter(|(e, _)| e[i] > 0).map(|(e, w)| {
                let factors = e.iter().enumerate().map(|(k, e)| if k == i { e - 1 } else { *e });
                let monomial = scaled.iter().zip(factors).filter(|(_, e)| *e > 0);
                let product = monomial
                    .fold(Expr::Num(1.0), |product, (x, e)| product * x.clone().pow(Expr::Num(f64::from(e))));
                (w * f64::from(e[i]), product)
            }))
        };
        let (_, g) = self.plant.frictionless();
        let acting = (0..n).filter(|i| g[*i] != Expr::Num(0.0));
        let pull = sum(acting.map(|i| (0.5 / (self.weights.input * widths[i]), g[i].clone() * gradient(i))));
        let law = match limits {
            Some(limits) => self.bounded(self.without_target(pull), limits),
            None => (self.target.input.clone() - pull).simplify(),
        };
        Ok(Made { frictionless: law.clone(), law, verification: Some(optimal.verification) })
    }

    /// −(u − u_e(r)) of the law u_d − `pull`.
    fn without_target(&self, pull: Expr) -> Expr {
        let (rest, target) = (&self.feed_forward.input, &self.target.input);
        if rest == target { pull } else { pull - (target.clone() - rest.clone()) }
    }

    /// Half widths of the box of a value function.
    fn half_widths(&self, domain: &[f64]) -> Result<Vec<f64>, ControlError> {
        let n = self.plant.order();
        let widths = if domain.is_empty() { self.plant.sizes().to_vec() } else { domain.to_vec() };
        if widths.len() != n {
            return Err(ControlError::Size { what: "the domain", found: widths.len(), wanted: n });
        }
        for (width, name) in widths.iter().zip(self.plant.state_names()) {
            if !(*width > 0.0 && width.is_finite()) {
                let what = format!("the half width of the domain in `{name}`");
                return Err(ControlError::Option { what, value: *width, wanted: "a positive finite number" });
            }
        }
        Ok(widths)
    }

    /// What the limits leave of the input behind the dead zone, with u_e(r) inside for every set point of the range.
    fn limits_behind_dead_zone(&self) -> Result<(f64, f64), ControlError> {
        let (low, high) = self.limits;
        if let Some(value) = [low, high].into_iter().find(|v| !v.is_finite()) {
            let what = "a limit of the input".to_owned();
            let wanted = "a finite number, above and below, for a bounded law: state the limits";
            return Err(ControlError::Option { what, value, wanted });
        }
        let swallowed = self.plant.dead_zone();
        let (low, high) = (low + swallowed, high - swallowed);
        let room = self.feed_forward.input_error + ROOM * (high - low);
        let (first, last) = self.feed_forward.range;
        let points = &self.feed_forward.equilibria;
        match points.iter().position(|at| !(low + room < at.input && at.input < high - room)) {
            None => Ok((low, high)),
            Some(k) => Err(ControlError::Unholdable {
                tracked: self.tracked.to_owned(),
                value: first + (last - first) * k as f64 / (points.len() - 1).max(1) as f64,
                input: points[k].input,
                low,
                high,
            }),
        }
    }

    /// The law of [`InputRange`] around u_e(r), where `pull` is −(u − u_e(r)) without limits: with
    /// T = (u_e(r) − m)/h, u = m + h tanh(atanh T − pull/(h (1 − T²))), the sum of angles written out.
    fn bounded(&self, pull: Expr, (low, high): (f64, f64)) -> Expr {
        let (middle, half) = (0.5 * (low + high), 0.5 * (high - low));
        let rest = ((self.feed_forward.input.clone() - Expr::Num(middle)) / Expr::Num(half)).simplify();
        let one = || Expr::Num(1.0);
        let share = (one() - rest.clone() * rest.clone()).simplify();
        let turn = Expr::call(Func::Tanh, vec![(pull / (Expr::Num(half) * share)).simplify()]);
        let angle = (rest.clone() - turn.clone()) / (one() - rest * turn);
        (Expr::Num(middle) + Expr::Num(half) * angle).simplify()
    }

    /// u = −(L (f(x) − ẋ_d) + (η/φ) sat_φ(L (x − x_d))) / (L g(x)) with L = Σ aₖ c Aᵏ.
    pub(crate) fn smc(&self, lambda: f64, eta: f64, phi: f64, friction: bool) -> Result<Made, ControlError> {
        let states = self.plant.order();
        let row = match states {
            1 => self.surface::<1>(lambda, eta, phi),
            2 => self.surface::<2>(lambda, eta, phi),
            3 => self.surface::<3>(lambda, eta, phi),
            4 => self.surface::<4>(lambda, eta, phi),
            5 => self.surface::<5>(lambda, eta, phi),
            6 => self.surface::<6>(lambda, eta, phi),
            7 => self.surface::<7>(lambda, eta, phi),
            8 => self.surface::<8>(lambda, eta, phi),
            _ => return Err(ControlError::SmcStates { states }),
        };
        let row =
            row.map_err(|source| ControlError::Smc { set_point: self.set_point, source, hint: self.hint() })?;
        let along = |e: &[Expr]| sum(row.iter().copied().zip(e.iter().cloned()));
        let deviations: Vec<Expr> = (0..states).map(|i| self.deviation(i)).collect();
        let surface = along(&deviations);
        let reaching = Expr::Num(eta / phi) * Expr::call(Func::Saturate, vec![surface, Expr::Num(phi)]);
        let rate = along(&self.target.rate);
        let law = |f: &[Expr], g: &[Expr]| {
            (-((along(f) - rate.clone() + reaching.clone()).simplify() / along(g))).simplify()
        };
        let (still_f, still_g) = self.plant.frictionless();
        let frictionless = law(still_f, still_g);
        let law = if friction { law(self.plant.f(), self.plant.g()) } else { frictionless.clone() };
        Ok(Made { law, frictionless, verification: None })
    }

    /// L, of the flat output of the tangent whose input gain is 1.
    fn surface<const N: usize>(&self, lambda: f64, eta: f64, phi: f64) -> Result<Vec<f64>, SmcError> {
        let a = std::array::from_fn(|i| std::array::from_fn(|j| self.tangent.a[(i, j)]));
        let tangent = Tangent::<N>::new(a, std::array::from_fn(|i| self.tangent.b[i]));
        let (surface, layer) = (Surface::repeated(lambda)?, BoundaryLayer::new(eta, phi)?);
        let law = greybox_smc::Design::new(tangent, surface, layer, self.dt).rate(Rate::Model).law()?;
        let (rows, weights) = (law.flat().rows(), law.surface().coefficients());
        Ok((0..N).map(|j| (0..N).map(|k| weights[k] * rows[k][j]).sum()).collect())
    }
}

/// The plant around an equilibrium, friction dropped, states counted in half widths and the input in its size.
struct Shifted<'a> {
    plant: &'a Plant,
    at: &'a Equilibrium,
    widths: &'a [f64],
    unit: f64,
}

impl Shifted<'_> {
    fn state(&self, x: &[f64]) -> Vec<f64> {
        (0..x.len()).map(|i| self.at.state[i] + self.widths[i] * x[i]).collect()
    }

    /// f(−x) = −f(x) and g(−x) = g(x), as far as points can tell.
    fn is_odd(&self, points: &[Vec<f64>]) -> bool {
        use greybox_hjb::Plant;
        let n = self.widths.len();
        let values = |x: &[f64]| {
            let (mut f, mut g) = (vec![0.0; n], vec![0.0; n]);
            self.drift(x, &mut f);
            self.input(x, &mut g);
            (f, g)
        };
        points.iter().all(|x| {
            let mirrored: Vec<f64> = x.iter().map(|x| -x).collect();
            let ((f, g), (mf, mg)) = (values(x), values(&mirrored));
            let small = |even: f64, size: f64| even.abs() <= ODD * size;
            let size = |v: &[f64]| v.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            (0..n).all(|i| small(f[i] + mf[i], size(&f)) && small(g[i] - mg[i], size(&g)))
        })
    }
}

impl greybox_hjb::Plant for Shifted<'_> {
    fn states(&self) -> usize {
        self.widths.len()
    }

    fn inputs(&self) -> usize {
        1
    }

    fn drift(&self, x: &[f64], f: &mut [f64]) {
        for ((f, rate), w) in
            f.iter_mut().zip(self.plant.frictionless_rate(&self.state(x), self.at.input)).zip(self.widths)
        {
            *f = rate / w;
        }
    }

    fn input(&self, x: &[f64], g: &mut [f64]) {
        self.plant.frictionless_input(&self.state(x), g);
        for (g, w) in g.iter_mut().zip(self.widths) {
            *g *= self.unit / w;
        }
    }
}
