// Runs one recording through a mesh of RANC's cores, and writes what every neuron did in every tick.
//
// sizes.vh says how large everything is. It reads csram_PLACE.mem and tc_PLACE.mem of each core, and input.txt: the
// number of ticks, and for each of them how many packets are due, and these. It writes core_PLACE.bin, for each tick a
// word of 32 bits a neuron (highest bit: it spiked; lowest: its membrane); out.txt, tick and number of each packet on
// the output bus; end.txt, the ticks that ran, cycles of the longest, packets lost, cycles with an error.
//
// A tick begins when all cores have done the one before and no packet is on its way. The packets that are due in it
// are sent while that one runs, in from the west of place 0.
`timescale 1ns / 1ps

module harness;
`include "sizes.vh"
    localparam DY_LSB = $clog2(AXONS) + $clog2(DELAYS), DX_LSB = DY_LSB + OFFSET_BITS, PACKET = DX_LSB + OFFSET_BITS;
    localparam PLACES = WIDTH * HEIGHT, BUS = BUS_X + WIDTH * BUS_Y;
    localparam MEMBRANE_LSB =
        PACKET + 1 + 2 * THRESHOLD_BITS + LEAK_BITS + WEIGHTS * WEIGHT_BITS + MEMBRANE_BITS;
    localparam ENDLESS = 16 * NEURONS * (AXONS + 64);  // cycles after which a tick will never end

    reg clk = 0, tick = 0, write = 0;
    reg [PACKET-1:0] packet = 0;
    integer waiting = 0;  // packets that are still to be sent for the next tick
    wire out_valid;
    wire [$clog2(OUTPUTS)-1:0] out;
    wire [PLACES-1:0] busy, sent, arrived, lost, core_errors, scheduler_errors;

    // of each place: a packet for the neighbour, whether there is none, whether one is taken from there
    wire [PACKET-1:0] to_west [0:PLACES-1], to_east [0:PLACES-1];
    wire [DX_LSB-1:0] to_north [0:PLACES-1], to_south [0:PLACES-1];
    wire [PLACES-1:0] none_west, none_east, none_north, none_south, from_west, from_east, from_north, from_south;
    wire taken = from_west[0] && waiting > 0;

`define MESH \
        .clk(clk), .rst(1'b0), .token_controller_error(core_errors[p]), .scheduler_error(scheduler_errors[p]), \
        .west_in(p == 0 ? packet : to_east[W]), .east_in(to_west[E]), .north_in(to_south[N]), .south_in(to_north[S]), \
        .west_out(to_west[p]), .east_out(to_east[p]), .north_out(to_north[p]), .south_out(to_south[p]), \
        .empty_in_west(p == 0 ? waiting == 0 : W == p ? 1'b1 : none_east[W]), \
        .empty_in_east(E == p ? 1'b1 : none_west[E]), \
        .empty_in_north(N == p ? 1'b1 : none_south[N]), .empty_in_south(S == p ? 1'b1 : none_north[S]), \
        .empty_out_west(none_west[p]), .empty_out_east(none_east[p]), \
        .empty_out_north(none_north[p]), .empty_out_south(none_south[p]), \
        .ren_in_west(W == p ? 1'b0 : from_east[W]), .ren_in_east(E == p ? 1'b0 : from_west[E]), \
        .ren_in_north(N == p ? 1'b0 : from_south[N]), .ren_in_south(S == p ? 1'b0 : from_north[S]), \
        .ren_out_west(from_west[p]), .ren_out_east(from_east[p]), \
        .ren_out_north(from_north[p]), .ren_out_south(from_south[p])

    genvar p;
    generate
        for (p = 0; p < PLACES; p = p + 1) begin : place
            // the neighbours; itself where there is none
            localparam W = p % WIDTH == 0 ? p : p - 1, E = p % WIDTH == WIDTH - 1 ? p : p + 1;
            localparam S = p < WIDTH ? p : p - WIDTH, N = p >= PLACES - WIDTH ? p : p + WIDTH;
            if (p == BUS) begin : way_out
                OutputBus #(
                    .PACKET_WIDTH(PACKET), .NUM_OUTPUTS(OUTPUTS), .NUM_AXONS(AXONS), .NUM_TICKS(DELAYS),
                    .DX_MSB(PACKET - 1), .DX_LSB(DX_LSB), .DY_MSB(DX_LSB - 1), .DY_LSB(DY_LSB), .ROUTER_BUFFER_DEPTH(4)
                ) bus (`MESH, .packet_out(out), .packet_out_valid(out_valid));
                assign busy[p] = 0, sent[p] = 0, lost[p] = 0, arrived[p] = out_valid;
            end else begin : tile
                // all read the same empty files, so that they are one module, and their own ones from here
                Core #(
                    .PACKET_WIDTH(PACKET), .NUM_NEURONS(NEURONS), .NUM_AXONS(AXONS), .NUM_TICKS(DELAYS),
                    .NUM_WEIGHTS(WEIGHTS), .NUM_RESET_MODES(2), .POTENTIAL_WIDTH(MEMBRANE_BITS),
                    .WEIGHT_WIDTH(WEIGHT_BITS), .LEAK_WIDTH(LEAK_BITS), .THRESHOLD_WIDTH(THRESHOLD_BITS),
                    .DX_MSB(PACKET - 1), .DX_LSB(DX_LSB), .DY_MSB(DX_LSB - 1), .DY_LSB(DY_LSB),
                    .ROUTER_BUFFER_DEPTH(4), .CSRAM_FILE("empty.mem"), .TC_FILE("empty.mem")
                ) core (`MESH, .tick(tick));
                reg [NEURONS-1:0] spiked = 0;
                reg [8*16-1:0] name;
                integer file, n;
                assign busy[p] = core.TokenController.state != 0;
                assign sent[p] = core.router_spike;
                assign arrived[p] = core.scheduler_wen;
                assign lost[p] = arrived[p] && core.scheduler_clr;  // what comes while old spikes are cleared
                initial begin
                    $sformat(name, "core_%03d.bin", p);
                    file = $fopen(name, "wb");
                    #1.5 $sformat(name, "csram_%03d.mem", p);
                    $readmemb(name, core.CSRAM.memory);
                    $sformat(name, "tc_%03d.mem", p);
                    $readmemb(name, core.TokenController.neuron_instructions);
                end
                always @(posedge clk) begin
                    if (sent[p]) spiked[core.CSRAM_addr] <= 1;
                    if (write) begin
                        for (n = 0; n < NEURONS; n = n + 1)
                            $fwrite(file, "%u", {spiked[n], {31 - MEMBRANE_BITS{1'b0}},
                                core.CSRAM.memory[n][MEMBRANE_LSB +: MEMBRANE_BITS]});
                        spiked <= 0;
                    end
                end
            end
        end
    endgenerate

    integer input_file /*verilator public*/;  // or Verilator 5.006 makes it local to each process
    integer out_file, end_file, got, ticks, left, change, k;
    integer now = -1, since = 0;  // tick that runs, and cycles since it began
    integer flying = 0;  // packets that were sent and have not arrived
    integer longest = 0, dropped = 0, errors = 0;
    initial begin
        input_file = $fopen("input.txt", "r");
        out_file = $fopen("out.txt", "w");
        got = $fscanf(input_file, "%d", ticks);
    end
    always #1 clk = ~clk;
    always @(posedge clk) begin
        since <= since + 1;
        tick <= 0;
        write <= 0;
        if (core_errors != 0 || scheduler_errors != 0) errors <= errors + 1;
        if (out_valid) $fwrite(out_file, "%0d %0d\n", now, out);

        left = waiting;
        change = 0;
        // in even cycles: cores clear what they have done in odd ones, and lose what comes just then
        if (since == 16) got = $fscanf(input_file, "%d", left);
        else if (taken) begin
            got = $fscanf(input_file, "%h", packet);
            left = waiting - 1;
            change = 1;
        end
        waiting <= left;
        if (sent != 0 || arrived != 0)
            for (k = 0; k < PLACES; k = k + 1) begin
                change = change + sent[k] - arrived[k];
                if (lost[k]) dropped = dropped + 1;
            end
        flying <= flying + change;

        if (now == ticks ? since == 4 : since == ENDLESS) begin
            end_file = $fopen("end.txt", "w");
            $fwrite(end_file, "%0d %0d %0d %0d\n", now, longest, dropped, errors);
            $finish;
        end else if (now < ticks && since > 20 && busy == 0 && left == 0 && flying + change == 0) begin
            if (now >= 0 && since > longest) longest <= since;
            write <= now >= 0;
            tick <= now + 1 < ticks;
            now <= now + 1;
            since <= 0;
        end
    end
endmodule
