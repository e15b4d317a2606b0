/* Print what a running bench says, in C with zenoh-pico (https://github.com/eclipse-zenoh/zenoh-pico).

   cc subscriber.c -o subscriber -DZENOH_LINUX $(pkg-config --cflags --libs zenohpico) -lpthread
   golfbench run                                # terminal 1
   ./subscriber bench1 tcp/127.0.0.1:7451       # terminal 2

   The library must take messages of 80 kB: cmake -DFRAG_MAX_SIZE=1000000 -DBATCH_UNICAST_SIZE=65535.
   The first line is the size of the contract, with a JSON Schema of each message that follows. */

#include <stdio.h>
#include <zenoh-pico.h>

static void print_payload(const z_loaned_sample_t *sample) {
    z_owned_string_t text;
    z_bytes_to_string(z_sample_payload(sample), &text);
    printf("%.*s\n", (int)z_string_len(z_loan(text)), z_string_data(z_loan(text)));
    fflush(stdout);
    z_drop(z_move(text));
}

static int fail(const char *what) {
    fprintf(stderr, "%s\n", what);
    return 1;
}

int main(int count, char **arguments) {
    if (count != 3) return fail("usage: subscriber BENCH ENDPOINT");
    z_owned_config_t config;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, arguments[2]);
    z_owned_session_t session;
    if (z_open(&session, z_move(config), NULL) < 0) return fail("no bench at this endpoint");

    char name[128];
    z_view_keyexpr_t key;
    snprintf(name, sizeof name, "golfbench/%s/schema", arguments[1]);
    if (z_view_keyexpr_from_str(&key, name) < 0) return fail("not the id of a bench");
    z_owned_closure_reply_t answered;
    z_owned_fifo_handler_reply_t answers;
    z_fifo_channel_reply_new(&answered, &answers, 1);
    z_owned_reply_t answer;
    if (z_get(z_loan(session), z_loan(key), "", z_move(answered), NULL) < 0 ||
        z_recv(z_loan(answers), &answer) != Z_OK || !z_reply_is_ok(z_loan(answer)))
        return fail("no answer: denied or not running");
    printf("contract of %zu bytes\n", z_bytes_len(z_sample_payload(z_reply_ok(z_loan(answer)))));
    z_drop(z_move(answer));

    snprintf(name, sizeof name, "golfbench/%s/state", arguments[1]);
    z_view_keyexpr_from_str(&key, name);
    z_owned_closure_sample_t arrived;
    z_owned_fifo_handler_sample_t samples;
    z_fifo_channel_sample_new(&arrived, &samples, 16);
    z_owned_subscriber_t subscriber;
    if (z_declare_subscriber(z_loan(session), &subscriber, z_loan(key), z_move(arrived), NULL) < 0)
        return fail("cannot subscribe");
    z_owned_sample_t sample;
    while (z_recv(z_loan(samples), &sample) == Z_OK) {
        print_payload(z_loan(sample));
        z_drop(z_move(sample));
    }
    z_drop(z_move(subscriber));
    z_drop(z_move(session));
    return fail("the bench has ended");
}
