/* Tools of tracking data, in both directions. */
#ifndef IGTL_GATEWAY_KERNEL_TOOLS_H
#define IGTL_GATEWAY_KERNEL_TOOLS_H

#include "_forms.h"
#include "_loops.h"

/* The row of a tool after the template of a form. */
static const uint8_t *tool_row(const struct ros_form *form, ssize_t tool)
{
    return form->template + form->room - form->rest + TOOL_TO_ROS * tool;
}

/* Whether the rows of tools are within the template, and one of them at least. */
static int has_tool_rows(const struct ros_form *form)
{
    ssize_t size = form->room - form->rest;
    if (size < 12 || form->rest < TOOL_TO_ROS || form->rest % TOOL_TO_ROS)
        return 0;
    if (form->width_at != TOOL_HEAD + MATRIX_BYTES && form->width_at != TOOL_HEAD + QUATERNION_BYTES)
        return 0;
    for (ssize_t i = 0; i < form->rest / TOOL_TO_ROS; i++) {
        const uint8_t *row = tool_row(form, i);
        if ((ssize_t)get_u32_ros(row + 24) > size - 8 || (ssize_t)get_u32_ros(row + 28) > size - POSE_BYTES)
            return 0;
    }
    return form->stamp_at <= size - 8;
}

/* Whether a content has the tools of a form, with these names and types. */
static int has_tools(const struct ros_form *form, const uint8_t *content, ssize_t size)
{
    if (size != form->count * form->width_at)
        return 0;
    for (ssize_t i = 0; i < form->count; i++)
        if (memcmp(content + form->width_at * i, tool_row(form, i), TOOL_COMPARED))
            return 0;
    return 1;
}

/* Write the poses of tools; not 0: the message needs the full path. */
static uint32_t put_tools(const struct ros_form *form, const struct igtl_bulk *stream, const uint8_t *content)
{
    ssize_t bytes = form->width_at - TOOL_HEAD;
    for (ssize_t i = 0; i < form->count; i++) {
        const uint8_t *tool = content + form->width_at * i + TOOL_HEAD;
        double numbers[12], pose[7];
        uint32_t odd = 0;
        for (ssize_t k = 0; k < bytes / 4; k++) {
            odd |= not_finite(get_u32(tool + 4 * k));
            numbers[k] = get_f32(tool + 4 * k);
        }
        if (odd || !pose_of_numbers(numbers, bytes, stream->times, stream->by, pose))
            return 1;
        memcpy(form->out + get_u32_ros(tool_row(form, i) + 28), pose, sizeof pose);
    }
    return 0;
}

/* A row of the parts of a message of tools: that before all of them, one for each, and that after them. */
static const uint8_t *row_from_ros(const struct ros_bulk *stream, ssize_t row)
{
    return stream->sample + stream->data_at + stream->height_at * stream->step + ROW_FROM_ROS * row;
}

static ssize_t pose_from_row(const struct ros_bulk *stream, ssize_t tool)
{
    return get_u32_ros(row_from_ros(stream, 1 + tool) + 8);
}

/* Whether a sample has the rows of its tools, with places in it. */
static int has_rows_from_ros(const struct ros_bulk *stream)
{
    ssize_t tools = stream->height_at;
    if (tools < 1 || tools > stream->size || (stream->step != TOOL_HEAD + MATRIX_BYTES && stream->step != TOOL_HEAD + QUATERNION_BYTES) ||
        stream->data_at < 12 || stream->data_at + tools * stream->step + ROW_FROM_ROS * (tools + 2) != stream->size)
        return 0;
    for (ssize_t i = 0; i < tools + 2; i++) {
        const uint8_t *row = row_from_ros(stream, i);
        ssize_t begin = get_u32_ros(row), end = get_u32_ros(row + 4), pose = get_u32_ros(row + 8);
        if (begin > end || end > stream->data_at || pose > stream->data_at - POSE_BYTES)
            return 0;
    }
    return 1;
}

/* Find the tools of a message; 0: it needs the full path. */
static int find_tools(const struct ros_bulk *stream, const uint8_t *cdr, ssize_t size, struct found *found)
{
    if (size != stream->data_at)
        return 0;
    for (ssize_t i = 0; i < stream->height_at + 2; i++) {
        const uint8_t *row = row_from_ros(stream, i);
        if (!equal(cdr, stream->sample, get_u32_ros(row), get_u32_ros(row + 4)))
            return 0;
    }
    found->data = cdr;
    found->count = stream->height_at;
    found->size = stream->height_at * stream->step;
    return 1;
}

/* Write the tools of a message; return the size of the content, or -1: it needs the full path. */
static ssize_t put_tools_to_igtl(const struct ros_bulk *stream, const struct found *found, uint8_t *out)
{
    memcpy(out, stream->sample + stream->data_at, (size_t)found->size);
    for (ssize_t i = 0; i < found->count; i++) {
        double numbers[12];
        if (!numbers_of_pose(found->data + pose_from_row(stream, i), stream->step - TOOL_HEAD, stream->times, stream->by, numbers))
            return -1;
        for (ssize_t k = 0; k < (stream->step - TOOL_HEAD) / 4; k++)
            put_f32(out + stream->step * i + TOOL_HEAD + 4 * k, numbers[k]);
    }
    return found->size;
}

#endif
