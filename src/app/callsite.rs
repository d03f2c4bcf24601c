//! A `tracing` callsite whose fields are known only at run time.

use std::sync::OnceLock;

use tracing::callsite::{Callsite, Identifier};
use tracing::dispatcher::get_default;
use tracing::field::{Field, FieldSet, Value};
use tracing::metadata::Kind;
use tracing::subscriber::Interest;
use tracing::{Event, Level, Metadata};

/// Most fields of any event. `tracing` takes a fixed number of fields; those that an event does not use stay empty.
const MOST_FIELDS: usize = 1_024;

/// A `tracing` callsite. It is never freed, as `tracing` requires: the code that emits the event makes it once.
pub struct RuntimeCallsite {
    metadata: OnceLock<Metadata<'static>>,
}

impl RuntimeCallsite {
    /// Events of this name, target and severity, with these fields.
    pub fn new(name: &'static str, target: &'static str, level: Level, fields: &[String]) -> &'static Self {
        let names: Vec<&'static str> =
            fields.iter().take(MOST_FIELDS).map(|name| &*name.clone().leak()).collect();
        let callsite: &'static Self = Box::leak(Box::new(Self { metadata: OnceLock::new() }));
        let fields = FieldSet::new(names.leak(), Identifier(callsite));
        let place = (Some(file!()), Some(line!()), Some(module_path!()));
        callsite.metadata.get_or_init(|| {
            Metadata::new(name, target, level, place.0, place.1, place.2, fields, Kind::EVENT)
        });
        tracing::callsite::register(callsite);
        callsite
    }

    /// Emits an event with one value for each field, in the order of the fields; `None` where the event has none.
    pub fn emit(&'static self, values: &[Option<&dyn Value>]) {
        let metadata = Callsite::metadata(self);
        get_default(|dispatch| {
            if !dispatch.enabled(metadata) {
                return;
            }
            let fields: Vec<Field> = metadata.fields().iter().collect();
            let Some(unused) = fields.first() else { return };
            let pair = |at: usize| {
                fields.get(at).map_or((unused, None), |field| (field, values.get(at).copied().flatten()))
            };
            let pairs: [(&Field, Option<&dyn Value>); MOST_FIELDS] = std::array::from_fn(pair);
            dispatch.event(&Event::new(metadata, &metadata.fields().value_set(&pairs)));
        });
    }
}

impl Callsite for RuntimeCallsite {
    // Interest is asked for at each event: these events are few.
    fn set_interest(&self, _: Interest) {}

    fn metadata(&self) -> &Metadata<'_> {
        self.metadata.get().expect("the callsite is set before it is used")
    }
}
