//! The rule of each path that a port answers: of midshift's own methods as their .proto files declare it, of all others here.
//!
//! Invariant: default deny. A path without a rule is for nobody, whoever asks. The rules of methods are made from the descriptors when this crate is built, so
//! that there is no second place to forget.

use midshift_core::identity::{Access, Caller, Object, Permission, Principal};
use midshift_core::overload::Class;
use midshift_core::reason::{Code, Kind, Reason, Refusal};

/// What a path needs; none: nobody may ask for it.
pub fn find(path: &str) -> Option<Access> {
    method(path).or_else(|| foreign(path))
}

fn method(path: &str) -> Option<Access> {
    include!(concat!(env!("OUT_DIR"), "/access.rs"))
}

/// What is not declared in a .proto of ours: health, reflection, pages.
fn foreign(path: &str) -> Option<Access> {
    let (permission, class) = match path {
        "/ready" | "/grpc.health.v1.Health/Check" => (Permission::Anybody, Class::Control),
        // It stays open for as long as its caller likes.
        "/grpc.health.v1.Health/Watch" => (Permission::SignedIn, Class::Status),
        "/metrics" => (Permission::Read, Class::Status),
        _ if path.starts_with("/grpc.reflection.") => (Permission::SignedIn, Class::Status),
        _ if ["/metadata/", "/targets/"].iter().any(|pages| path.starts_with(pages)) => {
            (Permission::SignedIn, Class::Bulk)
        }
        _ => return None,
    };
    Some(Access { permission, object: Object::None, class })
}

/// What is shed first; a path without a rule is the first to go.
pub fn class(path: &str) -> Class {
    find(path).map_or(Class::Bulk, |access| access.class)
}

/// Whether an answer to that path goes on for as long as its caller likes.
pub fn is_watch(path: &str) -> bool {
    path.rsplit('/').next().is_some_and(|method| method.starts_with("Watch"))
}

/// Whether a call of that path may bring thousands of small messages up.
pub fn is_batch(path: &str) -> bool {
    path == "/midshift.task.v1.TaskService/SubmitTasks"
}

/// Whether this caller may ask for that path at all.
///
/// # Errors
/// Not signed in, not permitted, or nobody may.
pub fn check(caller: &Caller, path: &str) -> Result<(), Refusal> {
    match find(path) {
        Some(access) => caller.may_call(access),
        None => match caller.principal() {
            // The services say themselves what is not there.
            Principal::Local => Ok(()),
            Principal::Nobody => Err(Refusal::new(Kind::Unauthenticated, Code::SignInNeeded)),
            _ => Err(Refusal::new(
                Kind::Denied,
                Reason::new(Code::NotPermitted, "no rule of this server lets anybody ask for that"),
            )),
        },
    }
}

/// Who asks, as the port found out. A request of which nobody says so is nobody's.
pub fn caller<T>(request: &tonic::Request<T>) -> Caller {
    request.extensions().get::<Caller>().cloned().unwrap_or_else(Caller::nobody)
}

/// A request of this process itself, which may do everything.
pub fn local<T>(message: T) -> tonic::Request<T> {
    let mut request = tonic::Request::new(message);
    request.extensions_mut().insert(Caller::local());
    request
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost_reflect::DescriptorPool;

    #[test]
    fn every_method_of_every_service_declares_who_may_call_it() {
        let pool = DescriptorPool::decode(crate::FILE_DESCRIPTOR_SET).expect("descriptors");
        let methods: Vec<_> = pool.services().flat_map(|service| service.methods().collect::<Vec<_>>()).collect();
        assert!(methods.len() > 70, "{}", methods.len());
        let path = |m: &prost_reflect::MethodDescriptor| format!("/{}/{}", m.parent_service().full_name(), m.name());
        let without: Vec<String> = methods.iter().map(path).filter(|path| method(path).is_none()).collect();
        assert_eq!(without, Vec::<String>::new());
    }

    #[test]
    fn a_request_of_which_nobody_says_who_asks_is_nobodys() {
        let unsaid = tonic::Request::new(());
        assert_eq!(caller(&unsaid), Caller::nobody());
        assert!(check(&caller(&unsaid), "/midshift.task.v1.TaskService/SubmitTask").is_err());
        assert_eq!(caller(&local(())), Caller::local());
    }

    #[test]
    fn a_path_without_a_rule_is_for_nobody() {
        assert_eq!(find("/midshift.task.v1.TaskService/DropAll"), None);
        assert_eq!(check(&Caller::nobody(), "/elsewhere").expect_err("nobody").kind(), Kind::Unauthenticated);
        assert!(check(&Caller::nobody(), "/grpc.health.v1.Health/Check").is_ok());
        for closed in ["/metrics", "/grpc.health.v1.Health/Watch"] {
            assert!(check(&Caller::nobody(), closed).is_err(), "{closed}");
        }
        let robot = Caller::robot(midshift_core::ids::RobotId::parse("r7").expect("an id"));
        assert_eq!(check(&robot, "/elsewhere").expect_err("a robot").kind(), Kind::Denied);
    }
}
