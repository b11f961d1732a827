//! The law of G. Leylaz's thesis (University of California, Merced, 2021), section 4.2, as it stands there: for the
//! rotary flexible link only, to reproduce its figures.
//!
//! Two things keep it from being the law of this crate. Its flat output belongs to a link without stiffness and
//! damping at the hub (Eq 4.5 and 4.6), so that ÿ_f = α and what follows hold only roughly: on the identified link
//! the poles are −100.2, −23.5 ± 14.0j and −4.57 instead of −100 and three times −16, and with λ = 4 one is at +0.57.
//! And its target (θ_d, 0, 0, 0) is no equilibrium, which leaves an error of 1° at 30° and of 2.5° at 15°. Use
//! [`Design`](crate::Design) with the tangent of the whole plant, and [`Target::rest`] at an equilibrium.

use crate::{BoundaryLayer, Command, Fault, FlatOutput, Law, Rate, SmcError, Surface, Tangent, Target};

/// The tangent of thesis Eq 4.5 and 4.6, without stiffness and damping of the hub:
///
/// ```text
/// θ″ = A₁ α + B_θ u
/// α″ = A₂ α + B_α u
/// ```
///
/// A₁ and A₂ are printed as a₁₁ and a₂₁, but are not those of Eq 2.24 and 2.25 (erratum E18).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinkTangent {
    /// A₁, 1/s².
    pub a1: f64,
    /// A₂, 1/s².
    pub a2: f64,
    /// B_θ, rad/(V s²).
    pub b_theta: f64,
    /// B_α, rad/(V s²).
    pub b_alpha: f64,
}

impl LinkTangent {
    /// Of the coefficients "Identified" in thesis Table 2.3: A₁ = 6.3840/0.0190, A₂ = −13.1712/0.0118, B_θ = 1/0.0190,
    /// B_α = −1/0.0118.
    pub const IDENTIFIED: Self =
        Self { a1: 6.3840 / 0.0190, a2: -13.1712 / 0.0118, b_theta: 1.0 / 0.0190, b_alpha: -1.0 / 0.0118 };

    /// C_θ and C_α of thesis Eq 4.7, in s²: y_f = C_θ θ + C_α α has ÿ_f = α.
    ///
    /// ```
    /// let (c_theta, c_alpha) = greybox_smc::thesis::LinkTangent::IDENTIFIED.flat_output();
    /// assert!((c_theta + 2.79939e-3).abs() < 1e-8 && (c_alpha + 1.73857e-3).abs() < 1e-8);
    /// ```
    #[must_use]
    pub fn flat_output(&self) -> (f64, f64) {
        let determinant = self.a1 * self.b_alpha - self.a2 * self.b_theta;
        (self.b_alpha / determinant, -self.b_theta / determinant)
    }

    /// As A and b, with the state (θ, α, θ̇, α̇).
    #[must_use]
    pub fn tangent(&self) -> Tangent<4> {
        let a =
            [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, self.a1, 0.0, 0.0], [0.0, self.a2, 0.0, 0.0]];
        Tangent::new(a, [0.0, 0.0, self.b_theta, self.b_alpha])
    }
}

/// The law of thesis Eq 4.19 with 4.20, as corrected by erratum E20:
///
/// ```text
/// u = (1/B_α) (y_d⁗ − ÿ_f/C_α − (B_α/B_θ) f_θ − 3λ e_f‴ − 3λ² ë_f − λ³ ė_f − η sat(s/φ))
///
/// y_f = C_θ θ + C_α α,  ÿ_f = α,  y_f‴ = α̇,  e_f = y_f − C_θ θ_d
/// ```
///
/// f_θ(x) is the whole acceleration θ″ of the nonlinear model without input, friction smoothed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PrintedLaw {
    law: Law<4>,
    link: LinkTangent,
}

impl PrintedLaw {
    /// λ (`lambda`, 1/s), η (rad/s²) and φ (rad/s), and the voltage limit.
    ///
    /// The thesis has λ = 16, η = 5·10⁴, φ = 500 and 10 V. Its |s| stays below 20: the law is the linear one with
    /// η/φ = 100 1/s, and η = 500, φ = 5 give nearly the same (erratum E21).
    ///
    /// # Errors
    /// Those of [`FlatOutput::new`], [`Surface::repeated`], [`BoundaryLayer::new`] and [`Law::new`].
    pub fn new(link: LinkTangent, lambda: f64, eta: f64, phi: f64, limit: f64) -> Result<Self, SmcError> {
        let flat = FlatOutput::new(&link.tangent())?.with_input_gain(link.b_alpha)?;
        let layer = BoundaryLayer::new(eta, phi)?;
        Ok(Self { law: Law::new(flat, Surface::repeated(lambda)?, layer, limit, Rate::Chain)?, link })
    }

    /// The voltage at x = (θ, α, θ̇, α̇) for the wanted angle θ_d, corrected: ÿ_f/C_α is α/C_α.
    ///
    /// # Errors
    /// [`Fault::NotFinite`].
    pub fn step(&self, x: &[f64; 4], f_theta: f64, theta_d: f64) -> Result<Command, Fault> {
        let (_, c_alpha) = self.link.flat_output();
        self.with_fourth_derivative(
            x,
            x[1] / c_alpha + self.link.b_alpha / self.link.b_theta * f_theta,
            theta_d,
        )
    }

    /// The voltage by the letter of Eq 4.19, where the second term is y_f⁗/C_α: the loop diverges (erratum E20).
    ///
    /// `fourth` is y_f⁗, which the formula needs to find the input on which it depends; that of the last sample,
    /// α″ under its voltage, is at hand.
    ///
    /// # Errors
    /// [`Fault::NotFinite`].
    pub fn step_by_the_letter(
        &self,
        x: &[f64; 4],
        f_theta: f64,
        fourth: f64,
        theta_d: f64,
    ) -> Result<Command, Fault> {
        let (_, c_alpha) = self.link.flat_output();
        self.with_fourth_derivative(
            x,
            fourth / c_alpha + self.link.b_alpha / self.link.b_theta * f_theta,
            theta_d,
        )
    }

    /// `drift` is what the law takes y_f⁗ to be without input.
    fn with_fourth_derivative(&self, x: &[f64; 4], drift: f64, theta_d: f64) -> Result<Command, Fault> {
        let g = [0.0, 0.0, self.link.b_theta, self.link.b_alpha];
        self.law.step(x, &[0.0, 0.0, 0.0, drift], &g, &Target::rest([theta_d, 0.0, 0.0, 0.0]))
    }

    /// The state feedback K of the corrected law inside its boundary layer, u = −K (x − (θ_d, 0, 0, 0)) in V/rad and
    /// V s/rad; `model` is the tangent of the whole nonlinear model, of which f_θ is taken.
    ///
    /// # Errors
    /// Those of [`Law::gains`].
    pub fn gains(&self, model: &Tangent<4>) -> Result<[f64; 4], SmcError> {
        let (_, c_alpha) = self.link.flat_output();
        let ratio = self.link.b_alpha / self.link.b_theta;
        let mut a = [[0.0; 4]; 4];
        a[3] = model.a[2].map(|entry| ratio * entry);
        a[3][1] += 1.0 / c_alpha;
        self.law.gains(&Tangent::new(a, self.link.tangent().b))
    }

    /// The general law inside, with the flat output of [`LinkTangent`].
    #[must_use]
    pub fn law(&self) -> &Law<4> {
        &self.law
    }
}
