//! A device with no more than WebGPU promises, and one that is lost on the way.

#![cfg(feature = "wgpu")]

use burn::tensor::Device;
use burn::tensor::wgpu::{WgpuSetup, wgpu};
use limpid_tests::devices;
use limpid_tests::tiny::{checkpoint, scene};
use std::future::Future;
use std::pin::pin;
use std::task::{Context, Poll, Waker};
use trainer::settings::BlurKind;
use trainer::{TrainError, Trainer};

/// What is ready at once, as everything that wgpu gives is outside of a browser.
fn now<T>(future: impl Future<Output = T>) -> T {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => value,
        Poll::Pending => panic!("wgpu keeps one waiting"),
    }
}

/// A device of the first adapter with WebGPU's default limits (8 storage buffers a kernel, 16 KiB that units share, 128 MiB a
/// binding), without any feature; and wgpu's hold on it. It has the adapter's units a cube: CubeCL takes as many for kernels of
/// Burn's, whatever the device was asked for.
fn smallest() -> (Device, wgpu::Device) {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapter = now(instance.request_adapter(&wgpu::RequestAdapterOptions::default()));
    let adapter = adapter.expect("an adapter, since `devices` has one");
    let has = adapter.limits();
    let limits = wgpu::Limits {
        max_compute_invocations_per_workgroup: has.max_compute_invocations_per_workgroup,
        max_compute_workgroup_size_x: has.max_compute_workgroup_size_x,
        max_compute_workgroup_size_y: has.max_compute_workgroup_size_y,
        max_compute_workgroup_size_z: has.max_compute_workgroup_size_z,
        ..wgpu::Limits::default()
    };
    let (device, queue) = now(adapter.request_device(&wgpu::DeviceDescriptor {
        required_limits: limits,
        ..wgpu::DeviceDescriptor::default()
    }))
    .expect("what WebGPU promises");
    let setup = WgpuSetup {
        backend: adapter.get_info().backend,
        instance,
        adapter,
        device: device.clone(),
        queue,
    };
    let burns = Device::wgpu_options().setup(setup).init();
    (burns.expect("a device"), device)
}

#[test]
fn what_webgpu_promises_is_enough_and_a_lost_device_is_an_error() {
    if devices().iter().all(|(name, _)| *name != "wgpu") {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    // From where blur is modelled.
    checkpoint(folder.path(), BlurKind::Both, 52);
    let (device, handle) = smallest();
    let mut trainer = Trainer::load(folder.path(), scene(), &device).expect("a checkpoint");
    for _ in 0..3 {
        trainer.step().expect("a step");
    }
    trainer.evaluate().expect("scores");

    handle.destroy();
    let saved = std::fs::read(folder.path().join("state.safetensors")).expect("a file");
    for error in [
        trainer.step().err(),
        trainer.evaluate().err(),
        trainer.run().gaussians(None).err(),
        trainer.run().motion_arrays().err(),
        trainer.run().rigid_parts(30.0, 4).err(),
        trainer.save(folder.path()).err(),
        Trainer::load(folder.path(), scene(), &device).err(),
    ] {
        let Some(TrainError::Device { reason }) = error else {
            panic!("the device is lost: {error:?}");
        };
        assert!(!reason.contains('\n'), "{reason}");
    }
    let kept = std::fs::read(folder.path().join("state.safetensors")).expect("a file");
    assert!(saved == kept, "the checkpoint is as it was");
    let resumed = Trainer::load(folder.path(), scene(), &Device::flex());
    let report = resumed.expect("a checkpoint knows no backend").step();
    assert_eq!(report.expect("a step").iteration, 53);
}
