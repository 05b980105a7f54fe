/* What we use of rcl's C interface, declared here because the rclpy wheels have no headers.
 *
 * The functions are looked up at run time in the librcl.so that rclpy has loaded.  Their interface is the same in every
 * ROS 2 from Humble to Jazzy, except for the end of rmw_message_info_t, which is not read here: it gets room to spare.
 * Source documents: rcl/publisher.h, rcl/subscription.h, rcutils/types/uint8_array.h, rmw/types.h of ROS 2 Jazzy.
 */
#ifndef IGTL_GATEWAY_RCL_H
#define IGTL_GATEWAY_RCL_H

#include <stddef.h>
#include <stdint.h>

#define RCL_RET_OK 0
#define RCL_RET_SUBSCRIPTION_TAKE_FAILED 401 /* there is no message */

/* rcutils_allocator_t */
struct rcl_allocator {
    void *(*allocate)(size_t size, void *state);
    void (*deallocate)(void *pointer, void *state);
    void *(*reallocate)(void *pointer, size_t size, void *state);
    void *(*zero_allocate)(size_t number, size_t size, void *state);
    void *state;
};

/* rcl_serialized_message_t: the bytes of a message with their 4-byte encapsulation */
struct rcl_serialized {
    uint8_t *buffer;
    size_t length;
    size_t capacity;
    struct rcl_allocator allocator;
};

/* rmw_message_info_t; stamps in UTC ns, 0 = unset */
struct rcl_message_info {
    int64_t source_ns;
    int64_t received_ns;
    uint64_t publication_number; /* counted by the publisher, from 1 */
    uint64_t reception_number;
    uint8_t rest[224];
};

typedef void (*rcl_callback)(const void *user_data, size_t events);

typedef int32_t (*rcl_take_function)(const void *subscription, struct rcl_serialized *message,
                                     struct rcl_message_info *info, void *allocation);
typedef int32_t (*rcl_publish_function)(const void *publisher, const struct rcl_serialized *message, void *allocation);
typedef int32_t (*rcl_count_function)(const void *publisher, size_t *subscriptions);
typedef int32_t (*rcl_set_callback_function)(const void *entity, rcl_callback callback, const void *user_data);

#endif
