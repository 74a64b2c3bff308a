//! Fits the translations of motion bases to the tracks of a turning body, from none at all.
#![allow(clippy::print_stdout, reason = "an example prints what it finds")]
use burn::tensor::{DType, Device, Tensor};
use motion_bases::glam::{DAffine3, DQuat, DVec3};
use motion_bases::{Fit, FitCamera, FitData, InitOptions, MotionBases, Tracks3d};
fn main() -> Result<(), motion_bases::MotionError> {
    let (num_frames, entries, num_bases, seed) = (12, 12 * 60, 4, 1);
    let position = |i: usize| {
        let arm = DVec3::new((i / num_frames) as f64, 1.0, 0.0).sin();
        DQuat::from_rotation_y(0.1 * (i % num_frames) as f64) * arm + 5.0 * DVec3::Z
    };
    let tracks = Tracks3d {
        num_frames,
        positions: (0..entries).map(position).collect(),
        visible: vec![true; entries],
        confidence: vec![1.0; entries],
        colors: vec![[0.5; 3]; entries / num_frames],
    };
    #[rustfmt::skip]
    let init = motion_bases::initialize(&tracks, &InitOptions { num_bases, fewest: false, seed })?;
    let device = Device::flex().autodiff();
    #[rustfmt::skip]
    let cameras = vec![FitCamera { cam_from_world: DAffine3::IDENTITY, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 }; num_frames];
    let data = FitData::new(&init, &cameras)?;
    let mut bases = MotionBases::from_init(&init, &device, DType::F32);
    let means = &Tensor::<1>::from_data(&*init.canonical_means(), &device).reshape([-1, 3]);
    let coefficients = &Tensor::<2>::zeros([means.dims()[0], init.num_bases], &device);
    bases.transls = bases.transls.zeros_like().require_grad();
    for step in 0..=100 {
        #[rustfmt::skip]
        let fit = Fit { bases: &bases, coefficients, means };
        let loss = motion_bases::fit_loss(&fit, &data, step, 101);
        println!("step {step}: loss {}", loss.clone().into_scalar::<f32>());
        let slope = bases.transls.grad(&loss.backward()).expect("a leaf");
        let fitted = bases.transls.inner() - slope.sign() * (0.1 - 0.001 * step as f64);
        bases.transls = fitted.autodiff().require_grad();
    }
    Ok(())
}
