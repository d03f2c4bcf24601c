//! Sensors: the receiver's fixes, rates and forces.

use nalgebra::{Rotation3, UnitQuaternion, Vector3};

use super::{BASE_LINK, GPS, IMU, RosTranslator, motion};
use crate::io::proto::host_time;
use crate::io::proto::windhover::{GnssEpoch, Rtk};
use crate::io::ros::{Header, Imu, NavSatFix, RosRecord, Transform};
use windhover_base::msg::InertialSample;
use windhover_base::time::{MonoTime, Span};

impl RosTranslator {
    /// `/gps/fix`. The height is given where the receiver reports it above the ellipsoid; its errors are taken as one
    /// sigma, the horizontal one as that of both axes together.
    pub(super) fn fix(&mut self, epoch: &GnssEpoch, log: MonoTime, out: &mut Vec<RosRecord>) {
        let t = host_time(epoch.timestamp.as_ref());
        if !self.statics.contains_key(&self.frame(GPS)) {
            let lever = Transform {
                header: Header::new(t, self.frame(BASE_LINK)),
                child_frame_id: self.frame(GPS),
                translation: motion::flu(&Vector3::from(self.antenna_m)),
                rotation: UnitQuaternion::identity(),
            };
            self.constant(lever, log, out);
        }
        let variances = epoch.hpe_m.zip(epoch.vpe_m).map(|(h, v)| [h * h / 2.0, h * h / 2.0, v * v]);
        let mut covariance = [0.0; 9];
        for (axis, variance) in variances.iter().flatten().enumerate() {
            covariance[4 * axis] = *variance;
        }
        let status = match (epoch.fix, epoch.rtk()) {
            (0, _) => -1,
            (_, Rtk::None) => 0,
            (_, Rtk::Float | Rtk::Fixed) => 2,
        };
        let height = epoch.alt_msl_m.zip(epoch.geoid_m).map(|(above_sea, geoid)| above_sea + geoid);
        let fix = NavSatFix {
            header: Header::new(t, self.frame(GPS)),
            status,
            latitude: epoch.lat_deg.unwrap_or(f64::NAN),
            longitude: epoch.lon_deg.unwrap_or(f64::NAN),
            altitude: height.unwrap_or(f64::NAN),
            position_covariance: covariance,
            position_covariance_type: u8::from(variances.is_some()),
        };
        out.push(RosRecord::new(self.topic("/gps/fix"), log, t, &fix));
    }

    /// `/imu/data`, in the sensor's own axes, with their mount as a transform and the configured noise as covariance
    /// (of the mean over a tenth of a second; without a configuration zeros, which mean "not known").
    pub(super) fn inertial(&mut self, sample: &InertialSample, t_recv: MonoTime, out: &mut Vec<RosRecord>) {
        let settings = self.imu.unwrap_or_default();
        let t = t_recv - Span::from_ms(settings.latency_ms);
        if !self.statics.contains_key(&self.frame(IMU)) {
            let body_from_imu = UnitQuaternion::from_rotation_matrix(&settings.body_from_imu());
            let mount = Transform {
                header: Header::new(t, self.frame(BASE_LINK)),
                child_frame_id: self.frame(IMU),
                translation: Vector3::zeros(),
                rotation: motion::flu_from_frd() * body_from_imu,
            };
            self.constant(mount, t_recv, out);
        }
        let sigma = |figure: f64| if self.imu.is_some() { figure } else { 0.0 };
        let imu = Imu {
            header: Header::new(t, self.frame(IMU)),
            orientation: Rotation3::identity().into(),
            orientation_covariance: diagonal(-1.0, 0.0),
            angular_velocity: sample.rate_rps.unwrap_or_default(),
            angular_velocity_covariance: of(sample.rate_rps, sigma(settings.rate_noise_dps.to_radians())),
            linear_acceleration: sample.force_mps2.unwrap_or_default(),
            linear_acceleration_covariance: of(sample.force_mps2, sigma(settings.force_noise_mps2)),
        };
        out.push(RosRecord::new(self.topic("/imu/data"), t_recv, t, &imu));
    }
}

/// The covariance of a vector that is present, or ROS's value for an absent one.
fn of(figures: Option<Vector3<f64>>, sigma: f64) -> [f64; 9] {
    figures.map_or(diagonal(-1.0, 0.0), |_| diagonal(sigma * sigma, sigma * sigma))
}

fn diagonal(first: f64, others: f64) -> [f64; 9] {
    [first, 0.0, 0.0, 0.0, others, 0.0, 0.0, 0.0, others]
}
