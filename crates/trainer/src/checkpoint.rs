//! A checkpoint is a whole run in one safetensors file, from which training goes on bit for bit, and which needs no data set to be
//! rendered.
//!
//! A checksum in its header stands for every byte of the file.
//!
//! Tensors: every parameter under its name, its moments under `adam.1.NAME` and `adam.2.NAME`, density
//! statistics, the blur model's tables. Metadata (JSON under the key `limpid`): see [`Header`].
//! The schedule, which follows from these, is made again on opening, and so are unseen views on going on.

use crate::adam::{AdamState, Steps};
use crate::blur::BlurModel;
use crate::changes::Change;
use crate::checksum;
use crate::corrections::Corrections;
use crate::density::DensityStats;
use crate::error::{CheckpointProblem, OtherScene};
use crate::inputs::Inputs;
use crate::model::Model;
use crate::optimizer::Optimizer;
use crate::plan::{Plan, schedule_of};
use crate::run::Run;
use crate::settings::{LEAST_ITERATIONS, Settings};
use crate::state::{Progress, State};
use crate::survey::Survey;
use crate::tensors::{host, tensor};
use crate::views::Views;
use crate::world::{MotionModel, World};
use burn::tensor::{DType, Device, Tensor};
use io::Scene;
use motion_bases::MotionBases;
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};

/// Version of the file's layout; others are refused.
const FORMAT: u32 = 8;

/// Pictures of a view may have so many pixels: a broken size must not ask for all memory.
const MAX_PIXELS: usize = 1 << 28;

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    format: u32,
    /// See [`checksum`].
    checksum: String,
    settings: Settings,
    /// The iterations that the schedule is made for: those that the run was started with.
    scheduled: usize,
    changes: Vec<Change>,
    inputs: Inputs,
    survey: Survey,
    views: Views,
    /// Whether there are unseen views.
    has_unseen: bool,
    progress: Progress,
    #[serde(default)]
    decisions: Vec<String>,
    num_dynamic: usize,
    has_motion: bool,
    adam_steps: BTreeMap<String, Steps>,
}

impl Run {
    pub(crate) fn to_bytes(&self) -> Result<Vec<u8>, CheckpointProblem> {
        let Self {
            plan,
            state,
            device,
            ..
        } = self;
        let mut tensors: Vec<(String, Tensor<2>)> = state
            .model
            .parameters()
            .into_iter()
            .map(|(parameter, tensor)| (parameter.name, tensor))
            .collect();
        for (name, state) in &state.optimizer.states {
            tensors.push((format!("adam.1.{name}"), state.moment1.clone()));
            tensors.push((format!("adam.2.{name}"), state.moment2.clone()));
        }
        for (name, table) in state.model.blur.tables(device) {
            tensors.push((name.to_owned(), table));
        }
        let mut buffers: Vec<(String, Vec<usize>, Vec<f32>)> = tensors
            .into_iter()
            .map(|(name, t)| (name, t.dims().to_vec(), host(t)))
            .collect();
        let DensityStats { grad_sum, count } = &state.density;
        for (name, values) in [("grad_sum", grad_sum), ("count", count)] {
            let values = host(values.clone());
            buffers.push((format!("density.{name}"), vec![values.len()], values));
        }

        let steps = state.optimizer.states.iter();
        let header = Header {
            format: FORMAT,
            checksum: checksum::OPEN.to_owned(),
            settings: plan.settings.clone(),
            scheduled: plan.schedule.iterations,
            changes: plan.changes.clone(),
            inputs: plan.inputs.clone(),
            survey: plan.survey.clone(),
            views: plan.views.clone(),
            has_unseen: plan.schedule.unseen_from.is_some(),
            progress: state.progress,
            decisions: state.decisions.clone(),
            num_dynamic: state.model.num_dynamic(),
            has_motion: state.model.world.motion.is_some(),
            adam_steps: steps
                .map(|(name, s)| (name.clone(), s.steps.clone()))
                .collect(),
        };
        let views = buffers
            .iter()
            .map(|(name, shape, values)| {
                TensorView::new(Dtype::F32, shape.clone(), bytemuck::cast_slice(values))
                    .map(|v| (name.as_str(), v))
            })
            .collect::<Result<Vec<_>, _>>()?;
        let metadata = HashMap::from([("limpid".to_owned(), serde_json::to_string(&header)?)]);
        let mut bytes = serialize(views, Some(metadata))?;
        checksum::seal(&mut bytes);
        Ok(bytes)
    }

    /// A run from the bytes of a checkpoint.
    pub(crate) fn from_bytes(bytes: &[u8], device: &Device) -> Result<Self, CheckpointProblem> {
        let header = header(bytes)?;
        let file = SafeTensors::deserialize(bytes)?;
        let device = device.clone().autodiff();
        let inner = device.clone().inner();
        let leaf = |name: &str| matrix(&file, name, &device).map(Tensor::require_grad);

        let num_frames = header.views.train.len();
        let motion = if header.has_motion {
            Some(MotionModel {
                bases: MotionBases {
                    rots: leaf("motion.rots")?,
                    transls: leaf("motion.transls")?,
                    num_frames,
                },
                coefficients: leaf("motion.coefficients")?,
            })
        } else {
            None
        };
        let world = World {
            means: leaf("gaussians.means")?,
            quats: leaf("gaussians.quats")?,
            log_scales: leaf("gaussians.log_scales")?,
            opacity_logits: leaf("gaussians.opacity_logits")?,
            sh: leaf("gaussians.sh")?,
            num_dynamic: header.num_dynamic,
            motion,
        };
        check_world(&world, &header)?;
        // A run that became longer has the moments of the one that was started.
        let scheduled = Settings {
            iterations: header.scheduled,
            ..header.settings.clone()
        };
        let (settings, survey) = (&scheduled, &header.survey);
        let mut blur = BlurModel::new(settings, survey, &header.views, (&device, DType::F32))
            .map_err(|e| CheckpointProblem::Blur(Box::new(e)))?;
        let mut corrections =
            Corrections::new(settings, survey, &header.views, (&device, DType::F32));
        let others = blur.parameters_mut();
        for (parameter, tensor) in others.into_iter().chain(corrections.parameters_mut()) {
            let read = leaf(&parameter.name)?;
            check_shape(&parameter.name, &read, tensor.dims())?;
            *tensor = read;
        }
        blur.restore(|name, shape| {
            let table = matrix(&file, name, &inner)?;
            check_shape(name, &table, shape)?;
            Ok::<_, CheckpointProblem>(table)
        })?;
        let model = Model {
            world,
            blur,
            corrections,
        };

        let mut optimizer = Optimizer::default();
        for (name, steps) in &header.adam_steps {
            let state = AdamState {
                moment1: matrix(&file, &format!("adam.1.{name}"), &inner)?,
                moment2: matrix(&file, &format!("adam.2.{name}"), &inner)?,
                steps: steps.clone(),
            };
            optimizer.states.insert(name.clone(), state);
        }
        for (parameter, tensor) in model.parameters() {
            let state = optimizer.states.get(&parameter.name);
            let fit = |s: &AdamState| s.fits(tensor.dims()) && s.steps_like(parameter.rows());
            if state.is_some_and(|state| !fit(state)) {
                return Err(CheckpointProblem::Moments {
                    parameter: parameter.name,
                });
            }
        }
        let (grad_sum, _) = values(&file, "density.grad_sum")?;
        let (count, _) = values(&file, "density.count")?;
        if grad_sum.len() != model.num_gaussians() || count.len() != model.num_gaussians() {
            return Err(CheckpointProblem::Contradiction(
                "the density statistics do not fit the Gaussians",
            ));
        }
        let density = DensityStats {
            grad_sum: tensor(grad_sum, [model.num_gaussians()], &inner),
            count: tensor(count, [model.num_gaussians()], &inner),
        };
        let plan = Plan {
            schedule: schedule_of(settings, &header.views, &model, header.has_unseen),
            settings: header.settings,
            changes: header.changes,
            inputs: header.inputs,
            survey: header.survey,
            views: header.views,
        };
        Ok(Self {
            plan,
            state: State {
                model,
                optimizer,
                density,
                progress: header.progress,
                decisions: header.decisions,
            },
            device,
            setback: None,
        })
    }

    /// Whether the training frames of a scene are those of this run; test views may differ.
    ///
    /// # Errors
    /// Says how they differ.
    pub fn check_scene(&self, scene: &Scene) -> Result<(), OtherScene> {
        let trained = &self.plan.views;
        let found = self.plan.views_of(scene);
        if found.train.len() != trained.train.len() {
            return Err(OtherScene::OtherFrames {
                trained: trained.train.len(),
                found: found.train.len(),
            });
        }
        let mut pairs = found.train.iter().zip(&trained.train);
        match pairs.find(|(found, trained)| found != trained) {
            None => Ok(()),
            Some((found, _)) => Err(OtherScene::OtherView {
                view: found.name.clone(),
            }),
        }
    }
}

fn header(bytes: &[u8]) -> Result<Header, CheckpointProblem> {
    let (_, metadata) = SafeTensors::read_metadata(bytes)?;
    let text = metadata.metadata().as_ref().and_then(|m| m.get("limpid"));
    let text = text.ok_or(CheckpointProblem::Foreign)?;
    // Every version writes JSON.
    let values: serde_json::Value =
        serde_json::from_str(text).map_err(|_| CheckpointProblem::Damaged)?;
    let found = match values.get("format") {
        None => "no format".to_owned(),
        Some(number) if number.is_u64() => format!("format {number}"),
        Some(_) => "a format that is no number".to_owned(),
    };
    if found != format!("format {FORMAT}") {
        return Err(CheckpointProblem::Format {
            found,
            expected: FORMAT,
        });
    }
    if !checksum::holds(bytes) {
        return Err(CheckpointProblem::Damaged);
    }
    let header: Header = serde_json::from_str(text)?;
    let valid = header.settings.validate();
    valid.map_err(|e| CheckpointProblem::Settings(Box::new(e)))?;
    if !(LEAST_ITERATIONS..=header.settings.iterations).contains(&header.scheduled) {
        return Err(CheckpointProblem::Contradiction(
            "the schedule is one of too few iterations, or of more than the run has",
        ));
    }
    if header.views.train.is_empty() {
        return Err(CheckpointProblem::Contradiction(
            "there is no training view",
        ));
    }
    let [near, far] = header.survey.depth_range;
    if ![header.survey.scene_size, near, far]
        .iter()
        .all(|depth| *depth > 0.0)
    {
        return Err(CheckpointProblem::Contradiction(
            "the scene's size and its depths are not over zero",
        ));
    }
    let mut views = header.views.train.iter().chain(&header.views.test);
    if views.any(|v| v.camera.width.saturating_mul(v.camera.height) > MAX_PIXELS) {
        return Err(CheckpointProblem::Contradiction(
            "a view has more than 2^28 pixels",
        ));
    }
    Ok(header)
}

/// Values and shape of a tensor.
fn values(file: &SafeTensors<'_>, name: &str) -> Result<(Vec<f32>, Vec<usize>), CheckpointProblem> {
    let view = file
        .tensor(name)
        .map_err(|_| CheckpointProblem::Missing(name.to_owned()))?;
    if view.dtype() != Dtype::F32 {
        return Err(CheckpointProblem::Type {
            tensor: name.to_owned(),
            found: format!("{:?}", view.dtype()),
        });
    }
    let values: Vec<f32> = bytemuck::pod_collect_to_vec(view.data());
    if let Some(at) = values.iter().position(|v| !v.is_finite()) {
        let columns = view.shape().iter().skip(1).product::<usize>().max(1);
        return Err(CheckpointProblem::NotFinite {
            tensor: name.to_owned(),
            value: values[at],
            row: at / columns,
        });
    }
    Ok((values, view.shape().to_vec()))
}

fn matrix(
    file: &SafeTensors<'_>,
    name: &str,
    device: &Device,
) -> Result<Tensor<2>, CheckpointProblem> {
    let (values, shape) = values(file, name)?;
    let shape: [usize; 2] = shape.try_into().map_err(|found| CheckpointProblem::Axes {
        tensor: name.to_owned(),
        found,
    })?;
    Ok(tensor(values, shape, device))
}

fn check_shape(
    name: &str,
    tensor: &Tensor<2>,
    expected: [usize; 2],
) -> Result<(), CheckpointProblem> {
    if tensor.dims() == expected {
        return Ok(());
    }
    Err(CheckpointProblem::Shape {
        tensor: name.to_owned(),
        found: tensor.dims().to_vec(),
        expected: expected.to_vec(),
    })
}

/// Every Gaussian parameter has a row per Gaussian, and the motion one per dynamic Gaussian.
fn check_world(world: &World, header: &Header) -> Result<(), CheckpointProblem> {
    let n = world.num_gaussians();
    let columns = 3 * (header.settings.gaussians.sh_degree + 1).pow(2);
    let mut expected = vec![
        ("gaussians.means", &world.means, [n, 3]),
        ("gaussians.quats", &world.quats, [n, 4]),
        ("gaussians.log_scales", &world.log_scales, [n, 3]),
        ("gaussians.opacity_logits", &world.opacity_logits, [n, 1]),
        ("gaussians.sh", &world.sh, [n, columns]),
    ];
    let mut problem = None;
    if let Some(MotionModel {
        bases,
        coefficients,
    }) = &world.motion
    {
        let (b, frames) = (bases.rots.dims()[0], bases.num_frames);
        expected.push(("motion.rots", &bases.rots, [b, 6 * frames]));
        expected.push(("motion.transls", &bases.transls, [b, 3 * frames]));
        expected.push(("motion.coefficients", coefficients, [world.num_dynamic, b]));
        problem = (b == 0).then_some("there is no motion basis");
    }
    for (name, tensor, shape) in expected {
        check_shape(name, tensor, shape)?;
    }
    if n == 0 {
        problem = Some("there is no Gaussian");
    } else if world.num_dynamic > n {
        problem = Some("there are more dynamic Gaussians than Gaussians");
    } else if world.motion.is_some() != (world.num_dynamic > 0) {
        problem = Some("motion and dynamic Gaussians come together");
    }
    problem.map_or(Ok(()), |what| Err(CheckpointProblem::Contradiction(what)))
}
