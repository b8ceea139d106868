//! Every role, every method of every service, in its own area and in another one: what the rule of a port and the rule of the object answer together.

use midshift_core::identity::{Access, Caller, Grant, Object, Permission, Role, Scope, TokenId};
use midshift_core::ids::{AreaId, RobotId};
use midshift_core::reason::{Kind, Refusal};
use midshift_proto::access;
use prost_reflect::DescriptorPool;
use std::collections::BTreeSet;

const OWN: &str = "packing";
const OTHER: &str = "storage";

fn area(name: &str) -> AreaId {
    AreaId::parse(name).expect("an id")
}

fn paths() -> Vec<(String, Access)> {
    let pool = DescriptorPool::decode(midshift_proto::FILE_DESCRIPTOR_SET).expect("descriptors");
    let methods = pool.services().flat_map(|service| service.methods().collect::<Vec<_>>());
    let paths = methods.map(|m| format!("/{}/{}", m.parent_service().full_name(), m.name()));
    paths.map(|path| (path.clone(), access::find(&path).expect(&path))).collect()
}

fn holder(role: Role, scope: Scope) -> Caller {
    let token = TokenId::new("t1").expect("an id");
    Caller::holder(token, "anna".into(), [Grant { role, scope }.into()].into(), false)
}

/// Whether the object of a method lies in areas, so that a service asks about it.
fn has_areas(object: Object) -> bool {
    match object {
        Object::None | Object::Site => false,
        Object::Area | Object::Robot | Object::Task | Object::Rollout | Object::Place | Object::List => true,
    }
}

/// As a port and then a service ask.
fn asked(caller: &Caller, path: &str, rule: Access, of: &AreaId) -> Result<(), Refusal> {
    access::check(caller, path)?;
    match rule.permission {
        Permission::Anybody | Permission::Robot | Permission::SignedIn | Permission::Stop => Ok(()),
        permission if has_areas(rule.object) => caller.authorize(permission, [of]),
        _ => Ok(()),
    }
}

/// What the table of roles and the declared rule say.
fn expected(role: Role, scope: &Scope, rule: Access, of: &AreaId) -> bool {
    match rule.permission {
        Permission::Anybody | Permission::SignedIn | Permission::Stop => true,
        Permission::Robot => false,
        permission => {
            let reaches = match rule.object {
                Object::None => true,
                Object::Site => *scope == Scope::Site,
                _ => *scope == Scope::Site || *scope == Scope::Area(of.clone()),
            };
            role.permissions().contains(&permission) && reaches
        }
    }
}

#[test]
fn each_role_may_call_each_method_where_its_grant_holds_and_nowhere_else() {
    let (paths, mut looked) = (paths(), 0);
    for role in Role::ALL {
        for scope in [Scope::Site, Scope::Area(area(OWN))] {
            let caller = holder(*role, scope.clone());
            for (path, rule) in &paths {
                for of in [area(OWN), area(OTHER)] {
                    let answer = asked(&caller, path, *rule, &of);
                    let what = format!("{} {scope:?} {path} {of}", role.as_str());
                    assert_eq!(answer.is_ok(), expected(*role, &scope, *rule, &of), "{what}: {answer:?}");
                    assert!(answer.err().is_none_or(|refused| refused.kind() == Kind::Denied), "{what}");
                    looked += 1;
                }
            }
        }
    }
    assert_eq!(looked, Role::ALL.len() * paths.len() * 4);
    assert!(paths.len() > 70, "{}", paths.len());
}

#[test]
fn methods_of_robots_are_for_robots_and_none_of_people_is() {
    let robot = Caller::robot(RobotId::parse("r7").expect("an id"));
    let names = |may: bool| -> BTreeSet<String> {
        let all = paths().into_iter().filter(|(path, _)| access::check(&robot, path).is_ok() == may);
        all.map(|(path, _)| path.rsplit_once('/').expect("a path").1.to_owned()).collect()
    };
    let open = ["Enrol", "GetMetadata", "WhoAmI"];
    let own = ["Attend", "FetchChunks", "GetEncoding", "RenewCertificate", "ReplayStatus", "Session"];
    // Who is not let in by its role is let in by nothing else: a robot engages no stop over the network either.
    assert_eq!(names(true), open.into_iter().chain(own).map(str::to_owned).collect());
    for (path, rule) in paths().into_iter().filter(|(_, rule)| rule.permission == Permission::Robot) {
        assert_eq!(rule.object, Object::Robot, "{path}");
    }
}

#[test]
fn what_nobody_should_have_to_look_up_is_as_it_was_said() {
    let may = |role: Role, path: &str| access::check(&holder(role, Scope::Site), path).is_ok();
    let who =
        |path: &str| -> Vec<&str> { Role::ALL.iter().filter(|role| may(**role, path)).map(|r| r.as_str()).collect() };
    for seen in ["Engage", "GetStatus", "WatchStatus"] {
        assert_eq!(who(&format!("/midshift.stop.v1.StopService/{seen}")).len(), Role::ALL.len(), "{seen}");
    }
    for (path, roles) in [
        ("/midshift.stop.v1.StopService/Reset", &["stop-resetter"][..]),
        ("/midshift.ota.v1.RolloutService/ApproveRollout", &["ota-approver"]),
        ("/midshift.ota.v1.RolloutService/StartRollout", &["ota-author"]),
        ("/midshift.ota.v1.BundleService/PublishRepository", &["ota-author"]),
        ("/midshift.task.v1.TaskService/SubmitTasks", &["dispatcher", "operator"]),
        ("/midshift.task.v1.TaskService/ResumeHeld", &["operator"]),
        ("/midshift.task.v1.TaskService/UpdateTask", &["dispatcher", "operator"]),
        ("/midshift.task.v1.TaskService/HoldTask", &["operator"]),
        ("/midshift.task.v1.TaskService/CancelTasks", &["dispatcher", "operator"]),
        ("/midshift.task.v1.TaskService/ResolveTasks", &["operator"]),
        ("/midshift.task.v1.TaskService/PutTaskType", &["operator"]),
        ("/midshift.task.v1.TaskService/DeleteTaskType", &["operator"]),
        ("/midshift.task.v1.TaskService/PutTaskTypeRules", &["operator"]),
        ("/midshift.fleet.v1.FleetService/PutAreaPolicy", &["operator"]),
        ("/midshift.fleet.v1.FleetService/PutPlanner", &["operator"]),
        ("/midshift.identity.v1.IdentityService/CreateToken", &["admin"]),
        ("/midshift.identity.v1.IdentityService/AdoptRobot", &["admin"]),
        ("/midshift.ota.v1.RolloutService/AcceptDeviceKey", &["admin"]),
        ("/midshift.sim.v1.SimService/InjectFault", &["operator"]),
    ] {
        assert_eq!(who(path), roles, "{path}");
    }
    let sees = who("/midshift.telemetry.v1.TelemetryService/ListRobots");
    let blind = Role::ALL.iter().map(|role| role.as_str()).filter(|role| !sees.contains(role)).collect::<Vec<_>>();
    assert_eq!(blind, ["stop-only"]);
}
