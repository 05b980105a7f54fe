/* A program on rcl: publishes every tenth message that it receives, and each tick of a timer. */
#include <rcl/rcl.h>
#include <rcutils/error_handling.h>
#include <std_msgs/msg/string.h>
#include <rosidl_runtime_c/string_functions.h>
#include <stdio.h>

static rcl_publisher_t publisher;
static int ticks;

static void tick(rcl_timer_t *timer, int64_t since)
{
    (void)timer, (void)since;
    ticks++;
}

int main(int argc, const char *const *argv)
{
    rcl_allocator_t memory = rcl_get_default_allocator();
    rcl_init_options_t options = rcl_get_zero_initialized_init_options();
    rcl_context_t context = rcl_get_zero_initialized_context();
    rcl_node_t node = rcl_get_zero_initialized_node();
    rcl_node_options_t node_options = rcl_node_get_default_options();
    rcl_subscription_t subscription = rcl_get_zero_initialized_subscription();
    rcl_publisher_options_t out = rcl_publisher_get_default_options();
    rcl_subscription_options_t in = rcl_subscription_get_default_options();
    const rosidl_message_type_support_t *type = ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, String);
    rcl_clock_t clock;
    rcl_timer_t timer = rcl_get_zero_initialized_timer();
    rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
    publisher = rcl_get_zero_initialized_publisher();
    if (rcl_init_options_init(&options, memory) || rcl_init(argc, argv, &options, &context) ||
        rcl_node_init(&node, "echo", "", &context, &node_options) ||
        rcl_publisher_init(&publisher, &node, type, "/out", &out) ||
        rcl_subscription_init(&subscription, &node, type, "/in", &in) ||
        rcl_clock_init(RCL_ROS_TIME, &clock, &memory) ||
        rcl_timer_init2(&timer, &clock, &context, RCL_MS_TO_NS(100), tick, memory, true) ||
        rcl_wait_set_init(&set, 1, 0, 1, 0, 0, 0, &context, memory)) {
        fprintf(stderr, "echo: %s\n", rcutils_get_error_string().str);
        return 1;
    }
    std_msgs__msg__String message, answer;
    std_msgs__msg__String__init(&message);
    std_msgs__msg__String__init(&answer);
    for (int count = 0;;) {
        (void)!rcl_wait_set_clear(&set);
        (void)!rcl_wait_set_add_subscription(&set, &subscription, NULL);
        (void)!rcl_wait_set_add_timer(&set, &timer, NULL);
        rcl_ret_t code = rcl_wait(&set, -1);
        if (code != RCL_RET_OK && code != RCL_RET_TIMEOUT)
            return 1;
        if (set.timers[0])
            (void)!rcl_timer_call(&timer);
        if (set.subscriptions[0] && rcl_take(&subscription, &message, NULL, NULL) == RCL_RET_OK && ++count % 10 == 0) {
            char text[200];
            rcl_time_point_value_t now;
            (void)!rcl_clock_get_now(&clock, &now);
            snprintf(text, sizeof text, "%s %d %d at %lld", message.data.data, count, ticks, (long long)now);
            rosidl_runtime_c__String__assign(&answer.data, text);
            (void)!rcl_publish(&publisher, &answer, NULL);
        }
    }
}
