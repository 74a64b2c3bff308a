//! Adam (Kingma and Ba, 2015) over rank-2 parameters, with state that follows row edits.
//!
//! The state is ours and not `burn::optim`'s, because density control clones, splits and removes
//! rows, and the moments have to follow.

use crate::cpu::adam::{AdamUpdate, SteppedRows};
use crate::density::{RowEdit, RowKind, gather_rows};
use crate::ops::{AdamTensors, TrainerOps};
use crate::parameter::Rows;
use crate::tensors::leaf;
use burn::backend::Dispatch;
use burn::tensor::{Tensor, TensorData};
use host::first_not_finite;
use serde::{Deserialize, Serialize};

/// Learning rate of one parameter.
#[derive(Clone, Debug, PartialEq)]
pub enum LearningRate {
    /// One rate for the whole tensor.
    Uniform(f64),
    /// One rate per column.
    PerColumn(Vec<f64>),
    /// The first rows of a parameter whose rows step together have other rates than those behind them, both per column.
    FirstRows {
        /// How many they are.
        rows: usize,
        /// Their rates.
        first: Vec<f64>,
        /// Those of the others.
        rest: Vec<f64>,
    },
}

impl LearningRate {
    /// `first` for columns [0, `num_first`), `rest` for those behind, `columns` in all.
    ///
    /// Spherical harmonics [N, 48] use it: three DC columns at 2.5e-3, the others at a twentieth.
    #[must_use]
    pub fn first_and_rest(first: f64, num_first: usize, rest: f64, columns: usize) -> Self {
        Self::PerColumn(
            (0..columns)
                .map(|column| if column < num_first { first } else { rest })
                .collect(),
        )
    }

    /// This rate for the first so many rows, and another for those behind them, of a parameter with so many columns.
    ///
    /// # Panics
    /// Panics if one of them tells first rows apart, or has another number of columns.
    #[must_use]
    pub fn then(&self, rows: usize, rest: &Self, columns: usize) -> Self {
        if self == rest || rows == 0 {
            return rest.clone();
        }
        let [first, rest] = [self, rest].map(|rate| {
            let (lead, rates) = rate.per_column(columns);
            assert!(lead.is_none(), "one rate for the rows of a part");
            rates
        });
        Self::FirstRows { rows, first, rest }
    }

    /// The first rows that have their own rates, with these, and the rates of all others; one for each column.
    fn per_column(&self, columns: usize) -> (Option<(usize, Vec<f64>)>, Vec<f64>) {
        let (lead, rates) = match self {
            Self::Uniform(rate) => (None, vec![*rate; columns]),
            Self::PerColumn(rates) => (None, rates.clone()),
            Self::FirstRows { rows, first, rest } => (Some((*rows, first.clone())), rest.clone()),
        };
        let all = lead.iter().map(|(_, rates)| rates).chain([&rates]);
        assert!(
            all.into_iter().all(|rates| rates.len() == columns),
            "one learning rate per column of the parameter"
        );
        (lead, rates)
    }
}

/// Steps taken of one parameter.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Steps {
    /// All rows step together; rows added later share the count (as in 3D Gaussian Splatting).
    Together(u32),
    /// Every row, a frame's for example, steps only when it is drawn, and has a count and with it a bias correction of its
    /// own, `[N]`. Momentum that went on between its visits would make it tremble.
    PerRow(Vec<u32>),
}

/// Adam's moments of one parameter [N, C] and the steps taken.
#[derive(Clone, Debug)]
pub struct AdamState {
    /// Running mean of the gradient, [N, C], on a device without autodiff.
    pub moment1: Tensor<2>,
    /// Running mean of the squared gradient, [N, C], on a device without autodiff.
    pub moment2: Tensor<2>,
    /// Steps taken.
    pub steps: Steps,
}

impl AdamState {
    /// Zero moments for `param`, [N, C], whose rows step together.
    #[must_use]
    pub fn new(param: &Tensor<2>) -> Self {
        let zeros = Tensor::zeros(param.dims(), (&param.device().inner(), param.dtype()));
        Self {
            moment1: zeros.clone(),
            moment2: zeros,
            steps: Steps::Together(0),
        }
    }

    /// Zero moments for `param`, [N, C], whose rows step by themselves.
    #[must_use]
    pub fn per_row(param: &Tensor<2>) -> Self {
        Self {
            steps: Steps::PerRow(vec![0; param.dims()[0]]),
            ..Self::new(param)
        }
    }

    /// Zero moments for `param`, [N, C], whose rows step as what they belong to asks.
    #[must_use]
    pub fn of(param: &Tensor<2>, rows: Rows) -> Self {
        match rows {
            Rows::Frames => Self::per_row(param),
            Rows::Gaussians | Rows::DynamicGaussians | Rows::Whole => Self::new(param),
        }
    }

    /// Whether the state is one of a parameter of this shape.
    #[must_use]
    pub fn fits(&self, [rows, columns]: [usize; 2]) -> bool {
        let moments = [&self.moment1, &self.moment2];
        moments.iter().all(|m| m.dims() == [rows, columns])
            && match &self.steps {
                Steps::Together(_) => true,
                Steps::PerRow(steps) => steps.len() == rows,
            }
    }

    /// Whether its rows step as what they belong to asks.
    #[must_use]
    pub fn steps_like(&self, rows: Rows) -> bool {
        match rows {
            Rows::Frames => matches!(self.steps, Steps::PerRow(_)),
            Rows::Gaussians | Rows::DynamicGaussians | Rows::Whole => {
                matches!(self.steps, Steps::Together(_))
            }
        }
    }

    /// Follows an edit of the parameter's rows: kept rows keep their moments and steps, new rows start at zero.
    pub fn gather(&mut self, edit: &RowEdit) {
        let device = self.moment1.device();
        let kept: Vec<f32> = edit
            .kind
            .iter()
            .map(|kind| f32::from(u8::from(*kind == RowKind::Kept)))
            .collect();
        let kept = Tensor::<2>::from_data(
            TensorData::new(kept, [edit.len(), 1]),
            (&device, self.moment1.dtype()),
        );
        self.moment1 = gather_rows(&self.moment1, edit) * kept.clone();
        self.moment2 = gather_rows(&self.moment2, edit) * kept;
        if let Steps::PerRow(steps) = &mut self.steps {
            let rows = edit.source.iter().zip(&edit.kind);
            *steps = rows
                .map(|(source, kind)| match kind {
                    RowKind::Kept => steps[*source as usize],
                    RowKind::Clone | RowKind::SplitChild => 0,
                })
                .collect();
        }
    }

    /// Forgets the moments of some rows. The steps stay.
    pub fn zero_rows(&mut self, rows: &[usize]) {
        let [count, _] = self.moment1.dims();
        let mut kept = vec![1.0_f32; count];
        for &row in rows {
            kept[row] = 0.0;
        }
        let options = (&self.moment1.device(), self.moment1.dtype());
        let kept = Tensor::<2>::from_data(TensorData::new(kept, [count, 1]), options);
        self.moment1 = self.moment1.clone() * kept.clone();
        self.moment2 = self.moment2.clone() * kept;
    }

    /// Forgets the moments, as after an opacity reset. The steps stay.
    pub fn zero_moments(&mut self) {
        self.moment1 = self.moment1.zeros_like();
        self.moment2 = self.moment2.zeros_like();
    }
}

/// A gradient that is infinite or not a number.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("the gradient at row {row}, column {column} is {value}")]
pub struct NonFiniteGradient {
    /// Row of the parameter.
    pub row: usize,
    /// Column of the parameter.
    pub column: usize,
    /// The value found.
    pub value: f64,
}

/// A gradient, [N, C], if every entry is finite; to be asked before anything is stepped.
///
/// # Errors
/// Names the first entry that is not finite.
pub fn finite_gradient(grad: Tensor<2>) -> Result<Tensor<2>, NonFiniteGradient> {
    match first_not_finite(&grad) {
        None => Ok(grad),
        Some((at, value)) => Err(NonFiniteGradient {
            row: at / grad.dims()[1],
            column: at % grad.dims()[1],
            value,
        }),
    }
}

/// How a parameter is stepped.
#[derive(Clone, Copy, Debug)]
pub struct AdamStep<'a> {
    /// Learning rate.
    pub rate: &'a LearningRate,
    /// Of a parameter whose rows step by themselves ([`Steps::PerRow`]), those that do, each once: moments, steps and values of
    /// the others stay as they are. A parameter whose rows step together does not look at it.
    pub drawn: &'a [usize],
}

/// One step of Adam on `param` [N, C], in place, with the constants of 3D Gaussian Splatting (0.9, 0.999, 1e-15): afterwards it
/// is a new leaf that requires its gradient if it was on an autodiff device, a plain tensor otherwise.
///
/// `grad` [N, C] is what `param.grad_remove(..)` gives, and finite ([`finite_gradient`]). No graph is recorded. An element whose
/// gradient is zero and whose moments are zero does not move. Magnitudes above 1e15 count as 1e15. Without other handles to
/// `param` its buffer is reused.
///
/// # Panics
/// Panics if the shapes or dtypes of `param`, `grad` and `state` differ, if the number of learning rates is not the number of
/// columns, if more rows have their own rate than there are or rows do not step together, or if a row is drawn that the parameter
/// does not have.
pub fn adam_step(
    param: &mut Tensor<2>,
    grad: Tensor<2>,
    state: &mut AdamState,
    step: &AdamStep<'_>,
) {
    let shape = param.dims();
    assert_eq!(shape, grad.dims(), "a gradient has its parameter's shape");
    assert!(
        state.fits(shape),
        "the state has its parameter's shape: row edits must reach it too"
    );
    let rows = match &mut state.steps {
        Steps::Together(steps) => {
            *steps += 1;
            SteppedRows::All(*steps)
        }
        Steps::PerRow(steps) => {
            let step_row = |row: &usize| {
                steps[*row] += 1;
                (*row, steps[*row])
            };
            SteppedRows::Drawn(step.drawn.iter().map(step_row).collect())
        }
    };
    let (lead, rates) = step.rate.per_column(shape[1]);
    if let Some((first, _)) = &lead {
        assert!(
            *first <= shape[0] && matches!(rows, SteppedRows::All(_)),
            "the first of rows that step together"
        );
    }
    let update = AdamUpdate { rates, lead, rows };
    let (autodiff, device, dtype) = (param.is_autodiff(), param.device().inner(), param.dtype());
    // What stays behind must not hold the buffer, or it would be copied.
    let take = |tensor: &mut Tensor<2>| {
        let placeholder = Tensor::empty([1, 1], (&device, dtype));
        std::mem::replace(tensor, placeholder)
            .inner()
            .into_dispatch()
    };
    let tensors = AdamTensors {
        parameter: take(param),
        moment1: take(&mut state.moment1),
        moment2: take(&mut state.moment2),
    };
    let stepped = <Dispatch as TrainerOps>::adam(tensors, grad.inner().into_dispatch(), update);
    state.moment1 = Tensor::from_dispatch(stepped.moment1);
    state.moment2 = Tensor::from_dispatch(stepped.moment2);
    *param = leaf(Tensor::from_dispatch(stepped.parameter), autodiff);
}
