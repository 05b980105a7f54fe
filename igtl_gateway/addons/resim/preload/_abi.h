/* What _preload.c knows of the interface between rcl and its middleware (rmw), declared here so that it compiles without ROS.
 *
 * The layouts are those of ROS 2 Jazzy; tests/addons/resim/test_abi.py compares each with the headers of the ROS wheels.
 * Source documents: rmw/types.h, rmw/init.h, rmw/init_options.h, rmw/event.h, rmw/names_and_types.h,
 * rcutils/types/uint8_array.h, rcutils/types/string_array.h, rosidl_runtime_c/{message,service}_type_support_struct.h.
 */
#ifndef IGTL_GATEWAY_PRELOAD_ABI_H
#define IGTL_GATEWAY_PRELOAD_ABI_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { ABI_OK = 0, ABI_ERROR = 1, ABI_TIMEOUT = 2, ABI_UNSUPPORTED = 3 };
enum { ABI_GID_BYTES = 16 };
enum { ABI_RELIABLE = 1, ABI_BEST_EFFORT = 2, ABI_RELIABILITY_BEST_AVAILABLE = 4 };
enum { ABI_KEEP_LAST = 1, ABI_KEEP_ALL = 2 };
enum { ABI_TRANSIENT_LOCAL = 1, ABI_VOLATILE = 2, ABI_DURABILITY_BEST_AVAILABLE = 4 };

struct abi_allocator {
    void *(*allocate)(size_t, void *);
    void (*deallocate)(void *, void *);
    void *(*reallocate)(void *, size_t, void *);
    void *(*zero_allocate)(size_t, size_t, void *);
    void *state;
};

/* rcutils_uint8_array_t, rmw_serialized_message_t */
struct abi_bytes {
    uint8_t *buffer;
    size_t length;
    size_t capacity;
    struct abi_allocator allocator;
};

/* rcutils_string_array_t */
struct abi_strings {
    size_t size;
    char **data;
    struct abi_allocator allocator;
};

/* rmw_names_and_types_t */
struct abi_names_and_types {
    struct abi_strings names;
    struct abi_strings *types;
};

/* rmw_time_t */
struct abi_time {
    uint64_t sec;
    uint64_t nsec;
};

/* rmw_qos_profile_t */
struct abi_qos {
    int history;
    size_t depth;
    int reliability;
    int durability;
    struct abi_time deadline;
    struct abi_time lifespan;
    int liveliness;
    struct abi_time liveliness_lease;
    bool avoid_ros_namespace_conventions;
};

/* rmw_init_options_t; only its size and its place in the context count here */
struct abi_init_options {
    uint64_t instance_id;
    const char *identifier;
    size_t domain_id;
    int enforce_security;
    char *security_root_path;
    int localhost_only;
    struct {
        int range;
        void *static_peers;
        size_t static_peers_count;
        struct abi_allocator allocator;
    } discovery;
    char *enclave;
    struct abi_allocator allocator;
    void *impl;
};

/* rmw_context_t */
struct abi_context {
    uint64_t instance_id;
    const char *identifier;
    struct abi_init_options options;
    size_t actual_domain_id;
    void *impl;
};

/* rmw_node_t */
struct abi_node {
    const char *identifier;
    void *data;
    const char *name;
    const char *namespace_;
    struct abi_context *context;
};

/* rmw_publisher_options_t */
struct abi_publisher_options {
    void *payload;
    int unique_flows;
};

/* rmw_publisher_t */
struct abi_publisher {
    const char *identifier;
    void *data;
    const char *topic;
    struct abi_publisher_options options;
    bool can_loan_messages;
};

/* rmw_subscription_options_t */
struct abi_subscription_options {
    void *payload;
    bool ignore_local_publications;
    int unique_flows;
    void *content_filter;
};

/* rmw_subscription_t */
struct abi_subscription {
    const char *identifier;
    void *data;
    const char *topic;
    struct abi_subscription_options options;
    bool can_loan_messages;
    bool is_filtered;
};

/* rmw_service_t, rmw_client_t, and the head of others: identifier, data, name */
struct abi_named {
    const char *identifier;
    void *data;
    const char *name;
};

/* rmw_guard_condition_t */
struct abi_guard {
    const char *identifier;
    void *data;
    struct abi_context *context;
};

/* rmw_wait_set_t */
struct abi_wait_set {
    const char *identifier;
    void *guards;
    void *data;
};

/* rmw_subscriptions_t, rmw_services_t, rmw_clients_t, rmw_events_t, rmw_guard_conditions_t */
struct abi_array {
    size_t count;
    void **items;
};

/* rmw_event_t */
struct abi_event {
    const char *identifier;
    void *data;
    int type;
};

/* rmw_request_id_t */
struct abi_request_id {
    uint8_t writer[ABI_GID_BYTES];
    int64_t number;
};

/* rmw_service_info_t */
struct abi_service_info {
    int64_t source_ns;
    int64_t received_ns;
    struct abi_request_id request;
};

/* rmw_gid_t */
struct abi_gid {
    const char *identifier;
    uint8_t data[ABI_GID_BYTES];
};

/* rmw_message_info_t */
struct abi_message_info {
    int64_t source_ns;
    int64_t received_ns;
    uint64_t publication_number;
    uint64_t reception_number;
    struct abi_gid publisher;
    bool from_intra_process;
};

/* rmw_message_sequence_t, rmw_message_info_sequence_t */
struct abi_sequence {
    void *data;
    size_t size;
    size_t capacity;
    struct abi_allocator *allocator;
};

/* rosidl_runtime_c__String */
struct abi_string {
    char *data;
    size_t size;
    size_t capacity;
};

/* rosidl_runtime_c__type_description__TypeSource and its sequence */
struct abi_source {
    struct abi_string type;
    struct abi_string encoding;
    struct abi_string text;
};
struct abi_sources {
    struct abi_source *data;
    size_t size;
    size_t capacity;
};

/* rosidl_message_type_support_t; the type's name is the first member of what get_description returns */
struct abi_message_type {
    const char *identifier;
    const void *data;
    const struct abi_message_type *(*func)(const struct abi_message_type *, const char *);
    const void *(*get_hash)(const struct abi_message_type *);
    const struct abi_string *(*get_description)(const struct abi_message_type *);
    const struct abi_sources *(*get_sources)(const struct abi_message_type *);
};

/* rosidl_service_type_support_t */
struct abi_service_type {
    const char *identifier;
    const void *data;
    const struct abi_service_type *(*func)(const struct abi_service_type *, const char *);
    const struct abi_message_type *request;
    const struct abi_message_type *response;
    const struct abi_message_type *event;
    void *(*create_event)(const void *, struct abi_allocator *, const void *, const void *);
    bool (*destroy_event)(void *, struct abi_allocator *);
    const void *(*get_hash)(const struct abi_service_type *);
    const struct abi_string *(*get_description)(const struct abi_service_type *);
    const struct abi_sources *(*get_sources)(const struct abi_service_type *);
};

typedef void (*abi_callback)(const void *user_data, size_t events);

#endif
