//! A flight in several segments has the solution and the covariances of the flight in one.

use windhover_base::settings::EstimatorConfig;
use windhover_estimate::batch::Predictor;

use crate::covariance_pass::look;
use crate::initial::filtered;
use crate::jacobians::flown;
use crate::noise::first as first_noise;
use crate::problem::Pass;
use crate::refine::{first_values, planned, stated};
use crate::result::Refined;
use crate::solve::solve;

#[test]
fn a_flight_in_segments_is_solved_as_in_one() {
    let (world, site, recording) = flown("follow", 3.0);
    let (rig, config) = (world.scenario().rig.clone(), EstimatorConfig::default());
    let recordings = [recording];
    let firsts = [filtered(&rig, &config, &site, &recordings[0])];
    let solved = |segment_len: usize| -> Refined {
        let mut predictor = Predictor::new(&rig, &config, &site);
        let plan = planned(&predictor, &recordings, &firsts, rig.target.len(), 30.0);
        let mut problem = stated((&rig, &config, &site), &recordings, plan, &mut predictor, &firsts);
        problem.segment_len = segment_len;
        let mut values = first_values(&problem, &firsts, &predictor, &rig, &site);
        let noise = first_noise(problem.targets, config.side_force_mps2, config.thrust_mps2, None);
        let mut pass = Pass::new(&problem, predictor);
        let factors = solve(&mut pass, &mut values, &noise, 1e-3, &mut |_| true).expect("a flight");
        let looked = look(&mut pass, &factors, &values, &noise, &site, &recordings);
        looked.expect("it was solved").refined
    };
    let (whole, parts) = (solved(usize::MAX), solved(7));
    assert!(whole.own.len() > 20 && whole.own.len() == parts.own.len());
    assert_eq!((whole.own, whole.targets), (parts.own, parts.targets));
    assert_eq!(whole.constants, parts.constants);
}
