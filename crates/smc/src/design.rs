//! From a tangent to a law that has passed every check.

use crate::check::ClosedLoop;
use crate::{BoundaryLayer, FlatOutput, Law, Rate, SmcError, Surface, Tangent};

/// A law to be designed and checked.
///
/// Three tangents may differ. The *design's* gives the flat output. The *model's* is that of the f and g that the
/// law will be stepped with. The *plant's* is what the loop is checked against. Where only the first is given, it is
/// all three, and the poles are those of the surface and −η/φ.
///
/// [`Design::law`] refuses
///
/// 1. a tangent that is not controllable, or hardly;
/// 2. a layer that a held command crosses within a sample, (η/φ) dt ≥ 2;
/// 3. a pole of the loop, inside the boundary layer, outside the left half plane;
/// 4. a pole of the same loop with the command held over the sample time outside the unit circle.
///
/// All of it is linear and around one equilibrium. It says nothing of the loop outside the layer, nor of the limit
/// of the input; check the law at other equilibria with [`check::ClosedLoop`](crate::check::ClosedLoop), and simulate
/// large steps.
///
/// ```
/// use greybox_smc::{BoundaryLayer, Design, SmcError, Surface, Tangent};
/// let cart = Tangent::new([[0.0, 1.0], [0.0, 0.0]], [0.0, 0.5]);
/// let (surface, layer) = (Surface::repeated(8.0)?, BoundaryLayer::new(30.0, 0.3)?);
/// let law = Design::new(cart, surface, layer, 0.01).limited_to(5.0).law()?;
/// assert_eq!(law.limit(), 5.0);
///
/// let refused = Design::new(cart, surface, layer, 0.03).law().unwrap_err();
/// assert!(matches!(refused, SmcError::LayerTooThin { .. }));
/// # Ok::<(), SmcError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
#[must_use = "a design does nothing until its law is asked for"]
pub struct Design<const N: usize> {
    tangent: Tangent<N>,
    surface: Surface<N>,
    layer: BoundaryLayer,
    dt: f64,
    limit: f64,
    input_gain: f64,
    rate: Rate,
    model: Option<Tangent<N>>,
    plant: Option<Tangent<N>>,
}

impl<const N: usize> Design<N> {
    /// A law with the flat output of a tangent, for a command held over `dt` s.
    pub fn new(tangent: Tangent<N>, surface: Surface<N>, layer: BoundaryLayer, dt: f64) -> Self {
        Self {
            tangent,
            surface,
            layer,
            dt,
            limit: f64::INFINITY,
            input_gain: 1.0,
            rate: Rate::Chain,
            model: None,
            plant: None,
        }
    }

    /// The actuator gives ±u_max at most; without this, anything.
    pub fn limited_to(self, limit: f64) -> Self {
        Self { limit, ..self }
    }

    /// The unit of the flat output: its input gain β, instead of 1 ([`FlatOutput::with_input_gain`]). η and φ are
    /// in this unit.
    pub fn input_gain(self, beta: f64) -> Self {
        Self { input_gain: beta, ..self }
    }

    /// Where the rates of the flat output come from; without this, [`Rate::Chain`].
    pub fn rate(self, rate: Rate) -> Self {
        Self { rate, ..self }
    }

    /// The tangent of the f and g that the law will be stepped with; without this, the plant's.
    pub fn model(self, tangent: Tangent<N>) -> Self {
        Self { model: Some(tangent), ..self }
    }

    /// The tangent of the plant, which may be fuller than that of the design; without this, the model's, or the
    /// design's.
    pub fn plant(self, tangent: Tangent<N>) -> Self {
        Self { plant: Some(tangent), ..self }
    }

    /// The law, or why not.
    ///
    /// # Errors
    /// Those of [`FlatOutput::new`] and [`Law::new`]; [`SmcError::SampleTime`]; [`SmcError::LayerTooThin`];
    /// [`SmcError::NoAuthority`]; [`SmcError::Unstable`]; [`SmcError::UnstableSampled`].
    pub fn law(&self) -> Result<Law<N>, SmcError> {
        let flat = FlatOutput::new(&self.tangent)?.with_input_gain(self.input_gain)?;
        let law = Law::new(flat, self.surface, self.layer, self.limit, self.rate)?;
        let (dt, rate) = (self.dt, self.layer.rate());
        if !(dt > 0.0 && dt.is_finite()) {
            return Err(SmcError::SampleTime { dt });
        }
        if rate * dt >= 2.0 {
            return Err(SmcError::LayerTooThin { rate, dt });
        }
        let plant = self.plant.or(self.model).unwrap_or(self.tangent);
        plant.check_finite("the tangent of the plant")?;
        let model = self.model.unwrap_or(plant);
        ClosedLoop::new(plant, law.gains(&model)?)?.check(dt)?;
        Ok(law)
    }
}
