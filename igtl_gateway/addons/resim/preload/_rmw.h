/* The functions of rmw that rcl calls; included by _preload.c only.
 *
 * Those without state (serialisation, options, validation, features) are not here: rcl finds them in rmw_fastrtps_cpp.
 */
#ifndef IGTL_GATEWAY_PRELOAD_RMW_H
#define IGTL_GATEWAY_PRELOAD_RMW_H

typedef int32_t ret;

/* -- contexts and nodes ------------------------------------------------------------------------------------------ */

ret rmw_init(const struct abi_init_options *options, struct abi_context *context)
{
    ret (*copy)(const void *, void *) = ROS(ret, rmw_init_options_copy, const void *, void *);
    if (!copy)
        return ABI_ERROR;
    context->instance_id = options->instance_id;
    context->identifier = IDENTIFIER;
    context->actual_domain_id = options->domain_id == SIZE_MAX ? 0 : options->domain_id;
    context->impl = context;
    join_session();
    return copy(options, &context->options);
}

ret rmw_shutdown(struct abi_context *context)
{
    (void)context;
    return ABI_OK;
}

ret rmw_context_fini(struct abi_context *context)
{
    ret (*fini)(void *) = ROS(ret, rmw_init_options_fini, void *);
    ret result = fini ? fini(&context->options) : ABI_ERROR;
    memset(context, 0, sizeof *context);
    return result;
}

static struct guard *new_guard(struct abi_context *context)
{
    struct guard *guard = calloc(1, sizeof *guard);
    if (guard)
        guard->handle = (struct abi_guard){IDENTIFIER, guard, context};
    return guard;
}

struct abi_node *rmw_create_node(struct abi_context *context, const char *name, const char *namespace_)
{
    refuse_copy("rmw_create_node");
    struct node *node = calloc(1, sizeof *node);
    if (!node)
        return NULL;
    node->handle = (struct abi_node){IDENTIFIER, node, strdup(name), strdup(namespace_), context};
    node->graph = new_guard(context);
    if (asprintf(&node->full_name, "%s%s%s", namespace_, strcmp(namespace_, "/") ? "/" : "", name) < 0)
        node->full_name = strdup(name);
    enter();
    node->next = S.nodes;
    S.nodes = node;
    leave();
    return &node->handle;
}

ret rmw_destroy_node(struct abi_node *handle)
{
    struct node *node = handle->data;
    enter();
    for (struct node **at = &S.nodes; *at; at = &(*at)->next)
        if (*at == node) {
            *at = node->next;
            break;
        }
    leave();
    free((char *)handle->name);
    free((char *)handle->namespace_);
    free(node->full_name);
    free(node->graph);
    free(node);
    return ABI_OK;
}

const struct abi_guard *rmw_node_get_graph_guard_condition(const struct abi_node *handle)
{
    return &((struct node *)handle->data)->graph->handle;
}

/* -- entities ---------------------------------------------------------------------------------------------------- */

static void announce(const struct entity *entity, bool is_made)
{
    const struct abi_message_type *message = entity->message_type;
    const struct abi_service_type *service = entity->service_type;
    const struct abi_sources *sources = NULL;
    if (is_made && message && message->get_sources && message->func)
        sources = message->get_sources(message);
    (void)service;
    size_t frame = begin_frame('E');
    PUT((char)entity->kind);
    PUT((uint8_t)is_made);
    PUT(entity->id);
    PUT((uint8_t)(entity->qos.reliability != ABI_BEST_EFFORT));
    PUT((uint8_t)(entity->qos.durability == ABI_TRANSIENT_LOCAL));
    PUT((uint8_t)(entity->qos.history == ABI_KEEP_ALL));
    PUT((uint32_t)entity->qos.depth);
    put_text(entity->name);
    put_text(entity->type);
    put_text(entity->node->full_name);
    /* the definition as rosbag2 stores it: the type's own, then each that it needs */
    for (size_t i = 0; sources && i < sources->size; i++) {
        const struct abi_source *source = &sources->data[i];
        if (i) {
            static const char line[] =
                "\n================================================================================\nMSG: ";
            put(line, sizeof line - 1);
            const char *slash = strchr(source->type.data, '/'), *last = strrchr(source->type.data, '/');
            if (slash && last) {
                put(source->type.data, (size_t)(slash - source->type.data));
                put(last, strlen(last));
            }
            put("\n", 1);
        }
        put(source->text.data, source->text.size);
    }
    end_frame(frame);
    S.stop = true;
    trigger_graph();
}

static struct entity *new_entity(int kind, const struct abi_node *node, const char *name, const struct abi_qos *qos,
                                 const struct abi_message_type *message, const struct abi_service_type *service)
{
    refuse_copy("rmw_create");
    struct entity *entity = calloc(1, sizeof *entity);
    if (!entity)
        return NULL;
    const struct abi_string *type = message && message->get_description   ? message->get_description(message)
                                    : service && service->get_description ? service->get_description(service)
                                                                          : NULL;
    entity->kind = kind;
    entity->name = strdup(name);
    entity->type = strdup(type && type->data ? type->data : "");
    entity->node = node->data;
    entity->message_type = message;
    entity->service_type = service;
    entity->qos = *qos;
    if (entity->qos.history != ABI_KEEP_ALL)
        entity->qos.history = ABI_KEEP_LAST;
    if (entity->qos.reliability != ABI_BEST_EFFORT)
        entity->qos.reliability = ABI_RELIABLE;
    if (entity->qos.durability != ABI_TRANSIENT_LOCAL)
        entity->qos.durability = ABI_VOLATILE;
    entity->buffer.allocator = *allocator();
    pthread_mutex_init(&entity->buffer_lock, NULL);
    enter();
    entity->id = ++S.ids;
    if (S.entities)
        S.last_entity->next = entity;
    else
        S.entities = entity;
    S.last_entity = entity;
    announce(entity, true);
    leave();
    return entity;
}

static void delete_entity(struct entity *entity)
{
    struct entity *before = NULL;
    enter();
    for (struct entity *each = S.entities; each && each != entity; each = each->next)
        before = each;
    if (before)
        before->next = entity->next;
    else
        S.entities = entity->next;
    if (S.last_entity == entity)
        S.last_entity = before;
    if (S.current_at == entity)
        S.current_at = entity->next;
    for (struct message *message = S.own; message; message = message->next)
        if (message->local == entity)
            message->local = NULL;
    if (S.current && S.current->local == entity)
        S.current->local = NULL;
    if (entity->callback)
        S.callbacks--;
    for (struct message *message = dequeue(entity); message; message = dequeue(entity))
        release(message);
    report_lost(entity);
    announce(entity, false);
    leave();
    free(entity->buffer.buffer);
    free(entity->name);
    free(entity->type);
    free(entity);
}

struct abi_publisher *rmw_create_publisher(const struct abi_node *node, const struct abi_message_type *type,
                                           const char *topic, const struct abi_qos *qos,
                                           const struct abi_publisher_options *options)
{
    struct abi_publisher *handle = calloc(1, sizeof *handle);
    struct entity *entity = handle ? new_entity(PUBLISHER, node, topic, qos, type, NULL) : NULL;
    if (!entity) {
        free(handle);
        return NULL;
    }
    *handle = (struct abi_publisher){IDENTIFIER, entity, entity->name, *options, false};
    return handle;
}

ret rmw_destroy_publisher(struct abi_node *node, struct abi_publisher *handle)
{
    (void)node;
    delete_entity(handle->data);
    free(handle);
    return ABI_OK;
}

struct abi_subscription *rmw_create_subscription(const struct abi_node *node, const struct abi_message_type *type,
                                                 const char *topic, const struct abi_qos *qos,
                                                 const struct abi_subscription_options *options)
{
    struct abi_subscription *handle = calloc(1, sizeof *handle);
    struct entity *entity = handle ? new_entity(SUBSCRIPTION, node, topic, qos, type, NULL) : NULL;
    if (!entity) {
        free(handle);
        return NULL;
    }
    entity->ignores_local = options->ignore_local_publications;
    *handle = (struct abi_subscription){IDENTIFIER, entity, entity->name, *options, false, false};
    return handle;
}

ret rmw_destroy_subscription(struct abi_node *node, struct abi_subscription *handle)
{
    (void)node;
    delete_entity(handle->data);
    free(handle);
    return ABI_OK;
}

static struct abi_named *new_named(int kind, const struct abi_node *node, const struct abi_service_type *type,
                                   const char *name, const struct abi_qos *qos)
{
    struct abi_named *handle = calloc(1, sizeof *handle);
    struct entity *entity = handle ? new_entity(kind, node, name, qos, NULL, type) : NULL;
    if (!entity) {
        free(handle);
        return NULL;
    }
    *handle = (struct abi_named){IDENTIFIER, entity, entity->name};
    return handle;
}

struct abi_named *rmw_create_client(const struct abi_node *node, const struct abi_service_type *type, const char *name,
                                    const struct abi_qos *qos)
{
    return new_named(CLIENT, node, type, name, qos);
}
struct abi_named *rmw_create_service(const struct abi_node *node, const struct abi_service_type *type, const char *name,
                                     const struct abi_qos *qos)
{
    return new_named(SERVICE, node, type, name, qos);
}
ret rmw_destroy_client(struct abi_node *node, struct abi_named *handle)
{
    (void)node;
    delete_entity(handle->data);
    free(handle);
    return ABI_OK;
}
ret rmw_destroy_service(struct abi_node *node, struct abi_named *handle) { return rmw_destroy_client(node, handle); }

struct abi_guard *rmw_create_guard_condition(struct abi_context *context)
{
    struct guard *guard = new_guard(context);
    return guard ? &guard->handle : NULL;
}
ret rmw_destroy_guard_condition(struct abi_guard *handle)
{
    free(handle->data);
    return ABI_OK;
}
ret rmw_trigger_guard_condition(const struct abi_guard *handle)
{
    atomic_store(&((struct guard *)handle->data)->triggered, 1);
    if (T.waiters)
        call_watcher();
    return ABI_OK;
}

struct abi_wait_set *rmw_create_wait_set(struct abi_context *context, size_t most)
{
    (void)context, (void)most;
    struct wait_set *set = calloc(1, sizeof *set);
    if (!set)
        return NULL;
    set->handle = (struct abi_wait_set){IDENTIFIER, NULL, set};
    enter();
    set->number = ++S.sets;
    leave();
    return &set->handle;
}
ret rmw_destroy_wait_set(struct abi_wait_set *handle)
{
    free(handle->data);
    return ABI_OK;
}

/* -- publishing -------------------------------------------------------------------------------------------------- */

enum { MOST_UNWRITTEN = 4096 };

/* rmw_serialize states the length that it estimates, which is more than it writes, as behind empty sequences of doubles.
 * The rest is what keeps another value in the second of two results, of which the first has 0 there. */
static ret cut_estimate(struct abi_bytes *buffer, const void *message, const struct abi_message_type *type,
                        ret (*real)(const void *, const void *, void *))
{
    size_t length = buffer->length, end = length;
    while (end && length - end < MOST_UNWRITTEN && !buffer->buffer[end - 1])
        end--;
    if (length - end < 4) /* as a string and the bytes behind it */
        return ABI_OK;
    memset(buffer->buffer + end, 0xFF, length - end);
    ret result = real(message, type, buffer);
    while (length > end && buffer->buffer[length - 1] == 0xFF)
        length--;
    memset(buffer->buffer + length, 0, buffer->length - length);
    for (size_t i = end; i < length; i++) /* between the fields */
        buffer->buffer[i] = 0;
    buffer->length = length;
    return result;
}

/* A message as CDR in the buffer of its entity, whose lock is held.  Bytes between the fields, which are not written, are 0. */
static ret serialise(struct entity *entity, const void *message, const struct abi_message_type *type)
{
    ret (*real)(const void *, const void *, void *) = ROS(ret, rmw_serialize, const void *, const void *, void *);
    struct abi_bytes *buffer = &entity->buffer;
    if (!real)
        return ABI_ERROR;
    for (;;) {
        const uint8_t *before = buffer->buffer;
        size_t room = buffer->capacity;
        if (room)
            memset(buffer->buffer, 0, room);
        ret result = real(message, type, buffer);
        if (result != ABI_OK)
            return result;
        if (before == buffer->buffer && room == buffer->capacity)
            return cut_estimate(buffer, message, type, real);
    }
}

static void send_published(struct entity *entity, const uint8_t *data, size_t size)
{
    refuse_copy("rmw_publish");
    enter();
    int64_t now = atomic_load(&T.now_ns);
    if (atomic_load(&T.active)) {
        size_t frame = begin_frame('O');
        PUT(entity->id);
        PUT(now);
        put(data, size);
        end_frame(frame);
        entity->published++;
        if (entity->routed != 2)
            S.stop = true;
        bool has_own = false;
        for (struct entity *each = S.entities; each && !has_own; each = each->next)
            has_own = each->kind == SUBSCRIPTION && !strcmp(each->name, entity->name);
        if (has_own) {
            struct message *message = new_message('M', entity->name, strlen(entity->name), data, size);
            message->t_ns = now + S.latency_ns, message->source_ns = now;
            message->class_ = CLASS_MESSAGE, message->local = entity;
            append(&S.own, &S.last_own, message);
        }
        if (S.out_size > FLUSH_BYTES)
            flush();
    }
    leave();
}

ret rmw_publish(const struct abi_publisher *handle, const void *message, void *allocation)
{
    (void)allocation;
    struct entity *entity = handle->data;
    pthread_mutex_lock(&entity->buffer_lock);
    ret result = serialise(entity, message, entity->message_type);
    if (result == ABI_OK)
        send_published(entity, entity->buffer.buffer, entity->buffer.length);
    pthread_mutex_unlock(&entity->buffer_lock);
    return result;
}

ret rmw_publish_serialized_message(const struct abi_publisher *handle, const struct abi_bytes *message, void *allocation)
{
    (void)allocation;
    send_published(handle->data, message->buffer, message->length);
    return ABI_OK;
}

ret rmw_send_request(const struct abi_named *handle, const void *request, int64_t *number)
{
    refuse_copy("rmw_send_request");
    struct entity *entity = handle->data;
    pthread_mutex_lock(&entity->buffer_lock);
    ret result = serialise(entity, request, entity->service_type->request);
    enter();
    *number = ++entity->requests;
    if (result == ABI_OK && atomic_load(&T.active)) {
        size_t frame = begin_frame('Q');
        PUT(entity->id);
        PUT(*number);
        PUT((int64_t)atomic_load(&T.now_ns));
        put(entity->buffer.buffer, entity->buffer.length);
        end_frame(frame);
        S.stop = true;
    }
    leave();
    pthread_mutex_unlock(&entity->buffer_lock);
    return result;
}

ret rmw_send_response(const struct abi_named *handle, struct abi_request_id *request, void *response)
{
    refuse_copy("rmw_send_response");
    struct entity *entity = handle->data;
    uint32_t from[2];
    memcpy(from, request->writer, sizeof from);
    pthread_mutex_lock(&entity->buffer_lock);
    ret result = serialise(entity, response, entity->service_type->response);
    enter();
    if (result == ABI_OK && atomic_load(&T.active)) {
        size_t frame = begin_frame('A');
        PUT(entity->id);
        PUT(from[0]);
        PUT(from[1]);
        PUT(request->number);
        PUT((int64_t)atomic_load(&T.now_ns));
        put(entity->buffer.buffer, entity->buffer.length);
        end_frame(frame);
        S.stop = true;
    }
    leave();
    pthread_mutex_unlock(&entity->buffer_lock);
    return result;
}

/* -- taking ------------------------------------------------------------------------------------------------------ */

static struct message *take(struct entity *entity)
{
    enter();
    struct message *message = dequeue(entity);
    leave();
    return message;
}
static void give_back(struct message *message)
{
    enter();
    release(message);
    leave();
}

static ret deserialise(const struct message *message, const struct abi_message_type *type, void *result)
{
    ret (*real)(const void *, const void *, void *) = ROS(ret, rmw_deserialize, const void *, const void *, void *);
    struct abi_bytes bytes = {message->data, message->size, message->size, *allocator()};
    return real ? real(&bytes, type, result) : ABI_ERROR;
}

static void inform(struct abi_message_info *info, const struct entity *entity, const struct message *message)
{
    memset(info, 0, sizeof *info);
    info->source_ns = message->source_ns;
    info->received_ns = message->t_ns;
    info->publication_number = UINT64_MAX; /* unsupported */
    info->reception_number = entity->taken;
    info->publisher.identifier = IDENTIFIER;
    uint32_t from = message->local ? message->local->id : 0;
    memcpy(info->publisher.data, &from, sizeof from);
}

ret rmw_take_with_info(const struct abi_subscription *handle, void *result, bool *taken, struct abi_message_info *info,
                       void *allocation)
{
    (void)allocation;
    struct entity *entity = handle->data;
    struct message *message = take(entity);
    *taken = false;
    if (!message)
        return ABI_OK;
    ret code = deserialise(message, entity->message_type, result);
    *taken = code == ABI_OK;
    if (info)
        inform(info, entity, message);
    give_back(message);
    return code;
}

ret rmw_take(const struct abi_subscription *handle, void *result, bool *taken, void *allocation)
{
    return rmw_take_with_info(handle, result, taken, NULL, allocation);
}

ret rmw_take_sequence(const struct abi_subscription *handle, size_t count, struct abi_sequence *messages,
                      struct abi_sequence *infos, size_t *taken, void *allocation)
{
    *taken = 0;
    while (*taken < count) {
        bool has = false;
        ret code = rmw_take_with_info(handle, ((void **)messages->data)[*taken], &has,
                                      (struct abi_message_info *)infos->data + *taken, allocation);
        if (code != ABI_OK)
            return code;
        if (!has)
            break;
        ++*taken;
    }
    messages->size = infos->size = *taken;
    return ABI_OK;
}

ret rmw_take_serialized_message_with_info(const struct abi_subscription *handle, struct abi_bytes *bytes, bool *taken,
                                          struct abi_message_info *info, void *allocation)
{
    (void)allocation;
    struct entity *entity = handle->data;
    struct message *message = take(entity);
    *taken = false;
    if (!message)
        return ABI_OK;
    if (bytes->capacity < message->size) {
        uint8_t *more = bytes->allocator.reallocate(bytes->buffer, message->size, bytes->allocator.state);
        if (!more) {
            give_back(message);
            return ABI_ERROR;
        }
        bytes->buffer = more;
        bytes->capacity = message->size;
    }
    memcpy(bytes->buffer, message->data, message->size);
    bytes->length = message->size;
    *taken = true;
    if (info)
        inform(info, entity, message);
    give_back(message);
    return ABI_OK;
}

ret rmw_take_serialized_message(const struct abi_subscription *handle, struct abi_bytes *bytes, bool *taken,
                                void *allocation)
{
    return rmw_take_serialized_message_with_info(handle, bytes, taken, NULL, allocation);
}

static ret take_named(const struct abi_named *handle, struct abi_service_info *info, void *result, bool *taken)
{
    struct entity *entity = handle->data;
    struct message *message = take(entity);
    *taken = false;
    if (!message)
        return ABI_OK;
    bool is_request = entity->kind == SERVICE;
    ret code = deserialise(message, is_request ? entity->service_type->request : entity->service_type->response, result);
    *taken = code == ABI_OK;
    memset(info, 0, sizeof *info);
    info->source_ns = info->received_ns = message->t_ns;
    info->request.number = (int64_t)message->number;
    uint32_t from[2] = {is_request ? message->program : S.program, is_request ? message->client : entity->id};
    memcpy(info->request.writer, from, sizeof from);
    give_back(message);
    return code;
}

ret rmw_take_request(const struct abi_named *handle, struct abi_service_info *info, void *request, bool *taken)
{
    return take_named(handle, info, request, taken);
}
ret rmw_take_response(const struct abi_named *handle, struct abi_service_info *info, void *response, bool *taken)
{
    return take_named(handle, info, response, taken);
}

/* -- waiting ----------------------------------------------------------------------------------------------------- */

static void keep_ready(struct abi_array *list, const void *ready, bool are_guards, bool takes_guards)
{
    for (size_t i = 0; list && i < list->count; i++) {
        bool is_ready = are_guards ? takes_guards && list->items[i] &&
                                         atomic_exchange(&((struct guard *)list->items[i])->triggered, 0)
                                   : list->items[i] && list->items[i] == ready;
        if (!is_ready)
            list->items[i] = NULL;
    }
}

/* After the session: until a guard condition is triggered, in real time. */
static bool wait_really(struct waiter *waiter, int64_t timeout_ns)
{
    int64_t until = timeout_ns == NEVER ? NEVER : real_ns(CLOCK_MONOTONIC) + timeout_ns;
    while (!has_triggered_guard(waiter)) {
        if (real_ns(CLOCK_MONOTONIC) >= until)
            return false;
        struct timespec pause = {.tv_nsec = 1000000};
        syscall(SYS_nanosleep, &pause, NULL);
    }
    return true;
}

/* The entity that has been ready for longest, of those that a wait asks for; NULL for none.  Under the lock. */
static struct entity *longest_ready(const struct waiter *waiter)
{
    struct entity *found = NULL;
    for (struct entity *entity = S.entities; entity; entity = entity->next)
        if (entity->first && (!found || entity->since < found->since) && asks_for(waiter, entity))
            found = entity;
    return found;
}

/* A poll returns guard conditions and an entity at once: rclpy.spin_once(timeout_sec=0) triggers a guard condition each time. */
ret rmw_wait(struct abi_array *subscriptions, struct abi_array *guards, struct abi_array *services,
             struct abi_array *clients, struct abi_array *events, struct abi_wait_set *set,
             const struct abi_time *timeout)
{
    refuse_copy("rmw_wait");
    struct abi_array *lists[] = {subscriptions, guards, services, clients, events};
    int64_t timeout_ns = !timeout || timeout->sec > 1000000000ULL
                             ? NEVER
                             : (int64_t)timeout->sec * NS_PER_S + (int64_t)timeout->nsec;
    struct waiter waiter = {.kind = WAIT_ROS, .deadline_ns = NEVER, .lists = lists};
    waiter.order = ((struct wait_set *)set->data)->number;
    bool is_poll = !timeout_ns && own_wait.in_wait && !own_wait.timeout_ns;
    own_wait.has_waited = true;
    own_in_callback = false;
    if (!atomic_load(&T.active)) {
        waiter.timed_out = !wait_really(&waiter, timeout_ns);
    } else if (is_poll && ++own_wait.polls < POLLS) {
        waiter.timed_out = true;
    } else {
        if (is_poll)
            timeout_ns = POLL_NS;
        int64_t now = atomic_load(&T.now_ns);
        waiter.deadline_ns = timeout_ns >= NEVER - now ? NEVER : now + timeout_ns;
        wait_for_turn(&waiter);
        if (!waiter.fired || !atomic_load(&T.active))
            waiter.timed_out = !waiter.ready && !has_triggered_guard(&waiter);
        own_wait.polls = 0;
    }
    if (is_poll && !waiter.ready && atomic_load(&T.active)) {
        enter();
        waiter.ready = longest_ready(&waiter);
        leave();
        waiter.timed_out = !waiter.ready && !has_triggered_guard(&waiter);
    }
    if (!waiter.timed_out)
        own_wait.polls = 0;
    for (int i = 0; i < 5; i++)
        keep_ready(lists[i], waiter.ready, i == 1, !waiter.timed_out && (is_poll || !waiter.ready));
    own_wait.has_given = waiter.ready || (!waiter.timed_out && !is_poll);
    own_in_callback = true;
    return waiter.timed_out ? ABI_TIMEOUT : ABI_OK;
}

/* rcl's own wait: what the program asked for, before rcl shortened it to the next timer. */
ret rcl_wait(void *set, int64_t timeout_ns)
{
    ret (*real)(void *, int64_t) = ROS(ret, rcl_wait, void *, int64_t);
    own_wait.in_wait = true;
    own_wait.has_waited = own_wait.has_given = false;
    own_wait.timeout_ns = timeout_ns;
    ret result = real ? real(set, timeout_ns) : ABI_ERROR;
    own_wait.in_wait = false;
    return result;
}

/* Starts the log, with a thread that flushes it every few seconds. */
ret rcl_logging_external_initialize(const char *prefix, const char *file, struct abi_allocator memory)
{
    ret (*real)(const char *, const char *, struct abi_allocator) =
        ROS(ret, rcl_logging_external_initialize, const char *, const char *, struct abi_allocator);
    own_starts_others = true;
    ret result = real ? real(prefix, file, memory) : ABI_ERROR;
    own_starts_others = false;
    return result;
}

/* One entity at a time: of several timers that are due, the first of the wait set; and none beside a message. */
ret rcl_timer_is_ready(const void *timer, bool *is_ready)
{
    ret (*real)(const void *, bool *) = ROS(ret, rcl_timer_is_ready, const void *, bool *);
    ret result = real ? real(timer, is_ready) : ABI_ERROR;
    if (result == ABI_OK && *is_ready && own_wait.in_wait && own_wait.has_waited && atomic_load(&T.active)) {
        if (own_wait.has_given)
            *is_ready = false;
        own_wait.has_given = true;
    }
    return result;
}

static ret set_callback(struct entity *entity, abi_callback callback, const void *user_data)
{
    enter();
    S.callbacks += (size_t)(callback != NULL) - (size_t)(entity->callback != NULL);
    entity->callback = callback;
    entity->user_data = user_data;
    size_t unseen = callback ? entity->count : 0;
    leave();
    if (unseen)
        callback(user_data, unseen);
    return ABI_OK;
}
ret rmw_subscription_set_on_new_message_callback(struct abi_subscription *handle, abi_callback callback, const void *data)
{
    return set_callback(handle->data, callback, data);
}
ret rmw_service_set_on_new_request_callback(struct abi_named *handle, abi_callback callback, const void *data)
{
    return set_callback(handle->data, callback, data);
}
ret rmw_client_set_on_new_response_callback(struct abi_named *handle, abi_callback callback, const void *data)
{
    return set_callback(handle->data, callback, data);
}

/* -- events of the middleware: none happens ---------------------------------------------------------------------- */

ret rmw_publisher_event_init(struct abi_event *event, const struct abi_publisher *publisher, int type)
{
    *event = (struct abi_event){IDENTIFIER, publisher->data, type};
    return ABI_OK;
}
ret rmw_subscription_event_init(struct abi_event *event, const struct abi_subscription *subscription, int type)
{
    *event = (struct abi_event){IDENTIFIER, subscription->data, type};
    return ABI_OK;
}
ret rmw_take_event(const struct abi_event *event, void *info, bool *taken)
{
    (void)event, (void)info;
    *taken = false;
    return ABI_OK;
}
ret rmw_event_set_callback(struct abi_event *event, abi_callback callback, const void *user_data)
{
    (void)event, (void)callback, (void)user_data;
    return ABI_OK;
}

/* -- quality of service ------------------------------------------------------------------------------------------ */

static ret qos_of(const struct entity *entity, struct abi_qos *qos)
{
    *qos = entity->qos;
    return ABI_OK;
}
ret rmw_publisher_get_actual_qos(const struct abi_publisher *handle, struct abi_qos *qos)
{
    return qos_of(handle->data, qos);
}
ret rmw_subscription_get_actual_qos(const struct abi_subscription *handle, struct abi_qos *qos)
{
    return qos_of(handle->data, qos);
}
ret rmw_client_request_publisher_get_actual_qos(const struct abi_named *handle, struct abi_qos *qos)
{
    return qos_of(handle->data, qos);
}
ret rmw_client_response_subscription_get_actual_qos(const struct abi_named *handle, struct abi_qos *qos)
{
    return qos_of(handle->data, qos);
}
ret rmw_service_request_subscription_get_actual_qos(const struct abi_named *handle, struct abi_qos *qos)
{
    return qos_of(handle->data, qos);
}
ret rmw_service_response_publisher_get_actual_qos(const struct abi_named *handle, struct abi_qos *qos)
{
    return qos_of(handle->data, qos);
}
ret rmw_publisher_assert_liveliness(const struct abi_publisher *handle)
{
    (void)handle;
    return ABI_OK;
}
ret rmw_publisher_wait_for_all_acked(const struct abi_publisher *handle, struct abi_time timeout)
{
    (void)handle, (void)timeout;
    return ABI_OK;
}

/* -- the graph --------------------------------------------------------------------------------------------------- */

static size_t count_of(int kind, const char *name)
{
    size_t count = 0;
    enter();
    for (const struct entity *entity = S.entities; entity; entity = entity->next)
        count += entity->kind == kind && !strcmp(entity->name, name);
    for (const struct elsewhere *each = S.elsewhere; each; each = each->next)
        if (each->kind == kind && each->count > 0 && !strcmp(each->name, name))
            count += (size_t)each->count;
    leave();
    return count;
}
#define COUNT(function, kind)                                                                                          \
    ret function(const struct abi_node *node, const char *name, size_t *count)                                         \
    {                                                                                                                  \
        (void)node;                                                                                                    \
        *count = count_of(kind, name);                                                                                 \
        return ABI_OK;                                                                                                 \
    }
COUNT(rmw_count_publishers, PUBLISHER)
COUNT(rmw_count_subscribers, SUBSCRIPTION)
COUNT(rmw_count_clients, CLIENT)
COUNT(rmw_count_services, SERVICE)

ret rmw_publisher_count_matched_subscriptions(const struct abi_publisher *handle, size_t *count)
{
    /* the recorder of the session subscribes to everything */
    *count = count_of(SUBSCRIPTION, handle->topic) + 1;
    return ABI_OK;
}
ret rmw_subscription_count_matched_publishers(const struct abi_subscription *handle, size_t *count)
{
    *count = count_of(PUBLISHER, handle->topic);
    return ABI_OK;
}
ret rmw_service_server_is_available(const struct abi_node *node, const struct abi_named *client, bool *is_available)
{
    (void)node;
    *is_available = count_of(SERVICE, client->name) > 0;
    return ABI_OK;
}

struct found {
    const char *name, *type;
};

static int by_name(const void *one, const void *other)
{
    const struct found *a = one, *b = other;
    int order = strcmp(a->name, b->name);
    return order ? order : strcmp(a->type, b->type);
}

/* Names and types of entities of one of two kinds, sorted; of one node, or of all programs. */
static ret names_and_types(int kind, int other_kind, const char *node, struct abi_allocator *memory,
                           struct abi_names_and_types *result)
{
    ret (*init)(void *, size_t, void *) = ROS(ret, rmw_names_and_types_init, void *, size_t, void *);
    ret (*init_strings)(void *, size_t, const void *) = ROS(ret, rcutils_string_array_init, void *, size_t, const void *);
    char *(*copy)(const char *, struct abi_allocator) = ROS(char *, rcutils_strdup, const char *, struct abi_allocator);
    if (!init || !init_strings || !copy)
        return ABI_ERROR;
    enter();
    size_t most = 0, count = 0, names = 0;
    for (const struct entity *entity = S.entities; entity; entity = entity->next)
        most++;
    for (const struct elsewhere *each = S.elsewhere; each; each = each->next)
        most++;
    struct found *found = calloc(most + 1, sizeof *found);
    for (const struct entity *entity = S.entities; found && entity; entity = entity->next)
        if ((entity->kind == kind || entity->kind == other_kind) && (!node || !strcmp(entity->node->full_name, node)))
            found[count++] = (struct found){entity->name, entity->type};
    for (const struct elsewhere *each = S.elsewhere; found && each && !node; each = each->next)
        if ((each->kind == kind || each->kind == other_kind) && each->count > 0)
            found[count++] = (struct found){each->name, each->type};
    if (count)
        qsort(found, count, sizeof *found, by_name);
    for (size_t i = 0; i < count; i++)
        names += !i || strcmp(found[i].name, found[i - 1].name);
    ret code = found ? ABI_OK : ABI_ERROR;
    if (code == ABI_OK && names)
        code = init(result, names, memory);
    for (size_t i = 0, at = 0; code == ABI_OK && i < count; at++) {
        size_t end = i, types = 0;
        for (; end < count && !strcmp(found[end].name, found[i].name); end++)
            types += end == i || strcmp(found[end].type, found[end - 1].type);
        result->names.data[at] = copy(found[i].name, *memory);
        code = init_strings(&result->types[at], types, memory);
        for (size_t k = i, type = 0; code == ABI_OK && k < end; k++)
            if (k == i || strcmp(found[k].type, found[k - 1].type))
                result->types[at].data[type++] = copy(found[k].type, *memory);
        i = end;
    }
    leave();
    free(found);
    return code;
}

ret rmw_get_topic_names_and_types(const struct abi_node *node, struct abi_allocator *memory, bool no_demangle,
                                  struct abi_names_and_types *result)
{
    (void)node, (void)no_demangle;
    return names_and_types(PUBLISHER, SUBSCRIPTION, NULL, memory, result);
}
ret rmw_get_service_names_and_types(const struct abi_node *node, struct abi_allocator *memory,
                                    struct abi_names_and_types *result)
{
    (void)node;
    return names_and_types(SERVICE, SERVICE, NULL, memory, result);
}

static ret of_node(int kind, struct abi_allocator *memory, const char *name, const char *namespace_,
                   struct abi_names_and_types *result)
{
    char full[512];
    snprintf(full, sizeof full, "%s%s%s", namespace_, strcmp(namespace_, "/") ? "/" : "", name);
    return names_and_types(kind, kind, full, memory, result);
}
ret rmw_get_publisher_names_and_types_by_node(const struct abi_node *node, struct abi_allocator *memory, const char *name,
                                              const char *namespace_, bool no_demangle, struct abi_names_and_types *result)
{
    (void)node, (void)no_demangle;
    return of_node(PUBLISHER, memory, name, namespace_, result);
}
ret rmw_get_subscriber_names_and_types_by_node(const struct abi_node *node, struct abi_allocator *memory,
                                               const char *name, const char *namespace_, bool no_demangle,
                                               struct abi_names_and_types *result)
{
    (void)node, (void)no_demangle;
    return of_node(SUBSCRIPTION, memory, name, namespace_, result);
}
ret rmw_get_service_names_and_types_by_node(const struct abi_node *node, struct abi_allocator *memory, const char *name,
                                            const char *namespace_, struct abi_names_and_types *result)
{
    (void)node;
    return of_node(SERVICE, memory, name, namespace_, result);
}
ret rmw_get_client_names_and_types_by_node(const struct abi_node *node, struct abi_allocator *memory, const char *name,
                                           const char *namespace_, struct abi_names_and_types *result)
{
    (void)node;
    return of_node(CLIENT, memory, name, namespace_, result);
}

ret rmw_get_node_names_with_enclaves(const struct abi_node *node, struct abi_strings *names,
                                     struct abi_strings *namespaces, struct abi_strings *enclaves)
{
    ret (*init)(void *, size_t, const void *) = ROS(ret, rcutils_string_array_init, void *, size_t, const void *);
    char *(*copy)(const char *, struct abi_allocator) = ROS(char *, rcutils_strdup, const char *, struct abi_allocator);
    (void)node;
    if (!init || !copy)
        return ABI_ERROR;
    enter();
    size_t count = 0;
    for (const struct node *each = S.nodes; each; each = each->next)
        count++;
    ret code = init(names, count, allocator());
    if (code == ABI_OK)
        code = init(namespaces, count, allocator());
    if (code == ABI_OK && enclaves)
        code = init(enclaves, count, allocator());
    for (const struct node *each = S.nodes; code == ABI_OK && each; each = each->next) {
        count--; /* in the order of their creation */
        names->data[count] = copy(each->handle.name, *allocator());
        namespaces->data[count] = copy(each->handle.namespace_, *allocator());
        if (enclaves)
            enclaves->data[count] = copy("/", *allocator());
    }
    leave();
    return code;
}
ret rmw_get_node_names(const struct abi_node *node, struct abi_strings *names, struct abi_strings *namespaces)
{
    return rmw_get_node_names_with_enclaves(node, names, namespaces, NULL);
}

static ret no_infos(struct abi_sequence *infos)
{
    /* rmw_topic_endpoint_info_array_t begins with its size and its data */
    memset(infos, 0, 2 * sizeof(void *));
    return ABI_OK;
}
ret rmw_get_publishers_info_by_topic(const struct abi_node *node, struct abi_allocator *memory, const char *topic,
                                     bool no_mangle, struct abi_sequence *infos)
{
    (void)node, (void)memory, (void)topic, (void)no_mangle;
    return no_infos(infos);
}
ret rmw_get_subscriptions_info_by_topic(const struct abi_node *node, struct abi_allocator *memory, const char *topic,
                                        bool no_mangle, struct abi_sequence *infos)
{
    (void)node, (void)memory, (void)topic, (void)no_mangle;
    return no_infos(infos);
}

static void gid_of(const struct entity *entity, struct abi_gid *gid)
{
    *gid = (struct abi_gid){.identifier = IDENTIFIER};
    uint32_t from[2] = {S.program, entity->id};
    memcpy(gid->data, from, sizeof from);
}
ret rmw_get_gid_for_publisher(const struct abi_publisher *handle, struct abi_gid *gid)
{
    gid_of(handle->data, gid);
    return ABI_OK;
}
ret rmw_get_gid_for_client(const struct abi_named *handle, struct abi_gid *gid)
{
    gid_of(handle->data, gid);
    return ABI_OK;
}
ret rmw_compare_gids_equal(const struct abi_gid *one, const struct abi_gid *other, bool *result)
{
    *result = !memcmp(one->data, other->data, ABI_GID_BYTES);
    return ABI_OK;
}

/* -- what is not there ------------------------------------------------------------------------------------------- */

/* Their arguments, which differ, are not read. */
#define UNSUPPORTED(function)                                                                                          \
    ret function(void)                                                                                                 \
    {                                                                                                                  \
        failed(#function " is not supported under resim");                                                             \
        return ABI_UNSUPPORTED;                                                                                        \
    }
UNSUPPORTED(rmw_borrow_loaned_message)
UNSUPPORTED(rmw_publish_loaned_message)
UNSUPPORTED(rmw_return_loaned_message_from_publisher)
UNSUPPORTED(rmw_return_loaned_message_from_subscription)
UNSUPPORTED(rmw_take_loaned_message)
UNSUPPORTED(rmw_take_loaned_message_with_info)
UNSUPPORTED(rmw_take_dynamic_message_with_info)
UNSUPPORTED(rmw_publisher_get_network_flow_endpoints)
UNSUPPORTED(rmw_subscription_get_network_flow_endpoints)
UNSUPPORTED(rmw_subscription_set_content_filter)
UNSUPPORTED(rmw_subscription_get_content_filter)

#endif
