//! A checkpoint is the whole state in one safetensors file, from which a run goes on bit for bit.
//!
//! Tensors: every parameter under its name, its moments under `adam.1.NAME` and `adam.2.NAME`, density
//! statistics, the gauge's table. Metadata (JSON under the key `limpid`): format version, settings,
//! progress, step counts. What depends on scene, settings and seed alone (unseen views, the schedule)
//! is made again on load.

use crate::TrainError;
use crate::adam::{AdamState, Steps};
use crate::density::DensityStats;
use crate::gauge::Gauge;
use crate::model::{Model, MotionModel, host, tensor};
use crate::optimizer::Optimizer;
use crate::schedule::{Modelled, Schedule};
use crate::settings::Settings;
use crate::survey::{Survey, survey};
use crate::trainer::{Progress, Trainer, make_unseen, new_blur};
use burn::tensor::{DType, Device, Tensor};
use io::Scene;
use motion_bases::MotionBases;
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Version of the file's layout; others are refused.
const FORMAT: u32 = 1;

/// Name of the file in a checkpoint's folder.
pub const FILE_NAME: &str = "state.safetensors";

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    format: u32,
    settings: Settings,
    survey: Survey,
    progress: Progress,
    num_frames: usize,
    num_dynamic: usize,
    has_motion: bool,
    has_blur: bool,
    adam_steps: BTreeMap<String, Steps>,
}

impl Trainer {
    /// Writes the whole state to `folder/state.safetensors`: under a temporary name first, synced, then renamed,
    /// so that a file that is there is whole.
    ///
    /// # Errors
    /// The file cannot be written; one that was there before is unharmed then.
    pub fn save(&self, folder: &Path) -> Result<(), TrainError> {
        let path = folder.join(FILE_NAME);
        let fail = |problem: String| TrainError::Checkpoint {
            path: path.clone(),
            problem,
        };
        let mut tensors: Vec<(String, Tensor<2>)> = self.model.parameters();
        for (name, state) in &self.optimizer.states {
            tensors.push((format!("adam.1.{name}"), state.moment1.clone()));
            tensors.push((format!("adam.2.{name}"), state.moment2.clone()));
        }
        tensors.push(("gauge".to_owned(), self.gauge.to_tensor(&self.device)));
        let mut buffers: Vec<(String, Vec<usize>, Vec<f32>)> = tensors
            .into_iter()
            .map(|(name, t)| (name, t.dims().to_vec(), host(t)))
            .collect();
        let rows = vec![self.density.count.len()];
        // Counts stay far below 2^24, where f32 is exact.
        let counts = self.density.count.iter().map(|&c| c as f32).collect();
        buffers.push((
            "density.grad_sum".to_owned(),
            rows.clone(),
            self.density.grad_sum.clone(),
        ));
        buffers.push(("density.count".to_owned(), rows, counts));

        let header = Header {
            format: FORMAT,
            settings: self.settings.clone(),
            survey: self.survey.clone(),
            progress: self.progress,
            num_frames: self.scene.frames.len(),
            num_dynamic: self.model.num_dynamic,
            has_motion: self.model.motion.is_some(),
            has_blur: self.model.blur.is_some(),
            adam_steps: self
                .optimizer
                .states
                .iter()
                .map(|(name, s)| (name.clone(), s.steps.clone()))
                .collect(),
        };
        let header = serde_json::to_string(&header).map_err(|e| fail(e.to_string()))?;
        let views = buffers
            .iter()
            .map(|(name, shape, values)| {
                TensorView::new(Dtype::F32, shape.clone(), bytemuck::cast_slice(values))
                    .map(|v| (name.as_str(), v))
            })
            .collect::<Result<Vec<_>, _>>()
            .map_err(|e| fail(e.to_string()))?;
        let metadata = HashMap::from([("limpid".to_owned(), header)]);
        let bytes = serialize(views, Some(metadata)).map_err(|e| fail(e.to_string()))?;
        Ok(io::write_atomic(&path, |file| file.write_all(&bytes))?)
    }

    /// Reads a checkpoint back, to go on from it or to render. `scene` is the one that was trained on.
    ///
    /// # Errors
    /// The file cannot be read, is not whole, is of another version, or does not fit the scene.
    pub fn load(folder: &Path, mut scene: Scene, device: &Device) -> Result<Self, TrainError> {
        let path = folder.join(FILE_NAME);
        let bytes = read(&path)?;
        let header = header(&path, &bytes)?;
        let fail = |problem: String| TrainError::Checkpoint {
            path: path.clone(),
            problem,
        };
        if scene.frames.len() != header.num_frames {
            return Err(fail(format!(
                "it was trained on {} frames and the scene has {}; give the scene (and --downscale, --images) of the run",
                header.num_frames,
                scene.frames.len()
            )));
        }
        let valid = header.settings.validate();
        valid.map_err(|e| fail(e.to_string()))?;
        // The survey is made again for what it does to the scene's depth, and must agree.
        let found = survey(&mut scene)?;
        if found.scene_size != header.survey.scene_size {
            return Err(fail(format!(
                "the scene's size is {} and was {} in training; give the scene (and --downscale, --images) of the run",
                found.scene_size, header.survey.scene_size
            )));
        }
        let device = device.clone().autodiff();
        let file = SafeTensors::deserialize(&bytes).map_err(|e| fail(e.to_string()))?;
        let values = |name: &str| -> Result<(Vec<f32>, Vec<usize>), TrainError> {
            let view = file
                .tensor(name)
                .map_err(|_| fail(format!("tensor {name} is missing; it is not whole")))?;
            if view.dtype() != Dtype::F32 {
                return Err(fail(format!(
                    "tensor {name} is {:?} and should be F32",
                    view.dtype()
                )));
            }
            let values: Vec<f32> = bytemuck::pod_collect_to_vec(view.data());
            if let Some(at) = values.iter().position(|v| !v.is_finite()) {
                let columns = view.shape().iter().skip(1).product::<usize>().max(1);
                let (value, row) = (values[at], at / columns);
                return Err(fail(format!("tensor {name} has {value} in row {row}")));
            }
            Ok((values, view.shape().to_vec()))
        };
        let matrix = |name: &str, device: &Device| -> Result<Tensor<2>, TrainError> {
            let (values, shape) = values(name)?;
            let shape: [usize; 2] = shape
                .try_into()
                .map_err(|s| fail(format!("tensor {name} has shape {s:?}, not two axes")))?;
            Ok(tensor(values, shape, device))
        };
        let leaf = |name: &str| matrix(name, &device).map(Tensor::require_grad);

        let motion = if header.has_motion {
            Some(MotionModel {
                bases: MotionBases {
                    rots: leaf("motion.rots")?,
                    transls: leaf("motion.transls")?,
                    num_frames: header.num_frames,
                },
                coefficients: leaf("motion.coefficients")?,
            })
        } else {
            None
        };
        let mut blur = None;
        if header.has_blur {
            let mut net = new_blur(&header.settings, header.num_frames, &device, DType::F32)?;
            for (name, parameter) in net.parameters_mut() {
                let read = leaf(&format!("blur.{name}"))?;
                if read.dims() != parameter.dims() {
                    return Err(fail(format!(
                        "blur.{name} is {:?} and should be {:?}",
                        read.dims(),
                        parameter.dims()
                    )));
                }
                *parameter = read;
            }
            blur = Some(net);
        }
        let model = Model {
            means: leaf("gaussians.means")?,
            quats: leaf("gaussians.quats")?,
            log_scales: leaf("gaussians.log_scales")?,
            opacity_logits: leaf("gaussians.opacity_logits")?,
            sh: leaf("gaussians.sh")?,
            num_dynamic: header.num_dynamic,
            motion,
            blur,
        };
        check_shapes(&model, &header).map_err(&fail)?;
        let inner = device.clone().inner();
        let mut optimizer = Optimizer::default();
        for (name, steps) in &header.adam_steps {
            let state = AdamState {
                moment1: matrix(&format!("adam.1.{name}"), &inner)?,
                moment2: matrix(&format!("adam.2.{name}"), &inner)?,
                steps: steps.clone(),
            };
            optimizer.states.insert(name.clone(), state);
        }
        for (name, parameter) in model.parameters() {
            let Some(state) = optimizer.states.get(&name) else {
                continue;
            };
            if !state.fits(parameter.dims()) {
                return Err(fail(format!(
                    "the moments of {name} do not have its shape {:?}",
                    parameter.dims()
                )));
            }
        }
        let (grad_sum, _) = values("density.grad_sum")?;
        let count: Vec<u32> = values("density.count")?
            .0
            .into_iter()
            .map(|c| c as u32)
            .collect();
        if grad_sum.len() != model.num_gaussians() || count.len() != model.num_gaussians() {
            return Err(fail(
                "the density statistics do not fit the Gaussians".to_owned(),
            ));
        }
        let cells = header.settings.blur.gauge_cells;
        let table = matrix("gauge", &inner)?;
        if table.dims() != [header.num_frames, 1 + 2 * cells[0] * cells[1]] {
            return Err(fail(format!(
                "the gauge's table has shape {:?}",
                table.dims()
            )));
        }
        let near = header.settings.gaussians.near * header.survey.scene_size;
        let unseen = make_unseen(&scene, &header.settings, &header.survey, near)
            .map_err(|e| fail(e.to_string()))?;
        let modelled = Modelled {
            motion: header.has_motion,
            blur: header.has_blur,
            unseen: !unseen.is_empty(),
        };
        Ok(Self {
            schedule: Schedule::new(&header.settings, header.num_frames, modelled),
            settings: header.settings,
            survey: header.survey,
            progress: header.progress,
            density: DensityStats { grad_sum, count },
            gauge: Gauge::from_tensor(cells, table),
            scene,
            device,
            model,
            optimizer,
            unseen,
        })
    }
}

fn read(path: &Path) -> Result<Vec<u8>, TrainError> {
    std::fs::read(path).map_err(|e| TrainError::Checkpoint {
        path: path.to_owned(),
        problem: e.to_string(),
    })
}

fn header(path: &Path, bytes: &[u8]) -> Result<Header, TrainError> {
    let fail = |problem: String| TrainError::Checkpoint {
        path: path.to_owned(),
        problem,
    };
    let (_, metadata) = SafeTensors::read_metadata(bytes)
        .map_err(|e| fail(format!("it is not a whole safetensors file ({e})")))?;
    let text = metadata.metadata().as_ref().and_then(|m| m.get("limpid"));
    let text = text.ok_or_else(|| fail("it is no checkpoint of limpid".to_owned()))?;
    let format = serde_json::from_str::<serde_json::Value>(text)
        .ok()
        .and_then(|v| v.get("format")?.as_u64());
    if format != Some(u64::from(FORMAT)) {
        return Err(fail(format!(
            "its format is {format:?}; this version reads {FORMAT}"
        )));
    }
    serde_json::from_str(text).map_err(|e| fail(format!("its header does not parse ({e})")))
}

/// Every Gaussian parameter has a row per Gaussian, and the motion one per dynamic Gaussian.
fn check_shapes(model: &Model, header: &Header) -> Result<(), String> {
    let n = model.num_gaussians();
    let columns = 3 * (header.settings.gaussians.sh_degree + 1).pow(2);
    let expected = [
        ("gaussians.means", &model.means, [n, 3]),
        ("gaussians.quats", &model.quats, [n, 4]),
        ("gaussians.log_scales", &model.log_scales, [n, 3]),
        ("gaussians.opacity_logits", &model.opacity_logits, [n, 1]),
        ("gaussians.sh", &model.sh, [n, columns]),
    ];
    for (name, tensor, shape) in expected {
        if tensor.dims() != shape {
            return Err(format!(
                "{name} is {:?} and should be {shape:?}",
                tensor.dims()
            ));
        }
    }
    if model.num_dynamic > n {
        return Err(format!("{} dynamic Gaussians of {n}", model.num_dynamic));
    }
    if n == 0 {
        return Err("there is no Gaussian".to_owned());
    }
    if model.motion.is_some() != (model.num_dynamic > 0) {
        return Err("motion and dynamic Gaussians come together".to_owned());
    }
    if let Some(motion) = &model.motion {
        let bases = motion.bases.rots.dims()[0];
        if bases == 0 {
            return Err("there is no motion basis".to_owned());
        }
        let expected = [
            (
                "motion.rots",
                &motion.bases.rots,
                [bases, 6 * header.num_frames],
            ),
            (
                "motion.transls",
                &motion.bases.transls,
                [bases, 3 * header.num_frames],
            ),
            (
                "motion.coefficients",
                &motion.coefficients,
                [model.num_dynamic, bases],
            ),
        ];
        for (name, tensor, shape) in expected {
            if tensor.dims() != shape {
                return Err(format!(
                    "{name} is {:?} and should be {shape:?}",
                    tensor.dims()
                ));
            }
        }
    }
    Ok(())
}
